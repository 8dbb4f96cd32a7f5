"""The training loop; networks, losses and data sets are passed in as objects."""
