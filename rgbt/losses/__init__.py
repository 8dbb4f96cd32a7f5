"""What a prediction costs against a label: set criterion, cross-entropy, self-distillation.

Pure functions and frozen settings. No network, no optimiser and no generator of its own lives
here; how passes and losses make a training step is `rgbt.schemes`.
"""
