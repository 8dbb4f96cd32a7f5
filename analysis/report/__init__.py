"""One page from the store: what was run, beside what was published."""
