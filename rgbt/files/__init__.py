"""Read files within budgets, write them atomically, and lock them."""
