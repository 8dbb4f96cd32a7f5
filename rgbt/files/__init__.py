"""Read files as plain data, write them atomically, and lock them."""
