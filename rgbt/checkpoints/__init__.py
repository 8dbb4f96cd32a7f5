"""Read weights of any known network from files, and write them, without executing their content."""
