"""Cache decoded images in memory-mapped files."""
