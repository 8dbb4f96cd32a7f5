"""Train one run, or a pipeline of a run and its upstream runs."""
