"""The life of one run, and the pipeline of several."""
