"""Networks: two images and an optional pair of masks in, `Output(logits, aux)` out.

One folder per family. A network never computes a loss, reads no file and draws no random number
except from the generator it is handed.
"""
