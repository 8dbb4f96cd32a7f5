"""Networks of other authors, built and called from their own checkouts; nothing is copied.

`building` imports and builds them, `calling` feeds them and finds the class scores, `network` is
the network of this project, `adapting` has tools for the adapters of odd repositories. The code of
the checkout is executed. A process can hold one checkout.
"""
