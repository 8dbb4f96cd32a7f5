"""Data sets of RGB, thermal, label triples, and the loader that makes batches of them.

What is here reads samples as they lie on disk and checks them. Augmentation is in
`rgbt.transforms`, masking in `rgbt.maskers`; loaders receive data set and transform as objects.
"""
