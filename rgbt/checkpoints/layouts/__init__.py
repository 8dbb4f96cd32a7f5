"""One module per kind of file, each with `recognise` and `rule` (see `rgbt.checkpoints.layout`)."""
