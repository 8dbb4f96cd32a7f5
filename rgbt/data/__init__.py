"""Read data sets of RGB, thermal and label images as they are on disk, and load batches of them.

Augmentation is in `rgbt.transforms`; loaders receive data set and transform as objects.
"""
