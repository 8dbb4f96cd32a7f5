"""Networks of other authors, built and called from their own checkouts; nothing is copied.

`network` is the network of this project, `adapters` builds those of odd repositories with the tools
of `adapting`. The code of the checkout is executed. A process can hold one checkout.
"""
