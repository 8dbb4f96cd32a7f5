"""Reading and writing files: within budgets, in one rename, under a lock."""
