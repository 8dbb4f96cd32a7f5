"""The image cache: images are decoded once and then read from memory-mapped files."""
