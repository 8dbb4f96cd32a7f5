"""Read data sets of RGB, thermal and label images, and load batches of them.

Readers return samples as they are on disk and check them. Augmentation is in `rgbt.transforms`,
masking in `rgbt.maskers`; loaders receive data set and transform as objects.
"""
