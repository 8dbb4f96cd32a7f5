"""Data sets of RGB, thermal, label triples, and the loader that makes batches of them.

Readers return samples as they are on disk and check them. Augmentation is in `rgbt.transforms`,
masking in `rgbt.maskers`; loaders receive data set and transform as objects.
"""
