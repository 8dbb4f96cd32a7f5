"""Networks of other authors, built and called from their own checkouts; nothing is copied.

`network` is the network of this project, `adapting` has tools for the adapters of odd repositories.
The code of the checkout is executed. A process can hold one checkout.
"""
