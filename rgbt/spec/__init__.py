"""What a run is: its specification, key, name and upstream runs."""
