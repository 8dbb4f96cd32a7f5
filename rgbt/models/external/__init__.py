"""Networks of other authors, built and called from their own checkouts; nothing is copied.

`checkout` imports them apart from everything else, `guard` keeps their constructors from loading
weights, `calling` feeds them and finds the class scores, `network` is the network of this project.
The code of the checkout is executed.
"""
