"""Files of weights: read without running anything in them, recognised, mapped, written.

`read.read` -> names and tensors; `recognise.recognise` -> what the file is; `load.load_weights` ->
into a network; `release.released` -> in the layout that the authors' code loads.
"""
