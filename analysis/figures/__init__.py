"""The papers' figures: a dataclass per family, a function that fills it and one that draws it."""
