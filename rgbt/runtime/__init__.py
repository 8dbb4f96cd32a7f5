"""The process: signals, and disks and memory that are full."""
