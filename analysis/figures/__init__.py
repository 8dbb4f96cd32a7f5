"""The papers' figures: per family a dataclass, a function that fills it and one that draws it."""
