"""Schemes, which define the passes and losses of one training step.

A scheme is built with the network, the loss and the masker and yields phases; the loop in
`rgbt.engine` runs them without knowing which scheme it is.
"""
