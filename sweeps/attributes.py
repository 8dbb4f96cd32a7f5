"""Names of the user attributes of trials and studies in Optuna's storage."""

# Attributes of a trial
RUNS = "rgbt.runs"  # keys of its runs, one per seed
LABEL = "rgbt.label"  # the point as shown
REASON = "rgbt.reason"  # why it failed or was pruned
SECONDS = "rgbt.seconds"  # duration of its runs, all processes together
RESULTS = "rgbt.results"  # "val/..." and "test/..." scores, mean over its seeds; percent
PIXELS = "rgbt.pixels"  # size of its images relative to the paper's, which scales ``${px:64}``

# Attributes of a study
SIGNATURE = "rgbt.signature"  # hash of its space and objectives, which must not change
METRICS = "rgbt.metrics"  # names of the objectives, in order
COMMAND = "rgbt.command"  # the command that created it
