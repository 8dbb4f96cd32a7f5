"""How one training step is made of passes and losses.

A scheme is built with the network, the loss and the masker and yields phases; the loop in
`rgbt.engine` runs them without knowing which scheme it is.
"""
