"""What a prediction costs: set criterion, cross-entropy, self-distillation against a label; maximum
squares, entropy and discriminators without one.

Pure functions and frozen settings. No network, no optimiser and no generator of its own lives
here; how passes and losses make a training step is `rgbt.schemes`.
"""
