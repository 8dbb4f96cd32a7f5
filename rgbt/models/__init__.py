"""Networks, which map two images and an optional pair of masks to `Output(logits, aux)`.

One module per family. A network never computes a loss, reads no file and draws no random number
except from the generator it is handed. All are called alike; each `forward` says what it adds:

    rgb        (N, 3, H, W) float in [0, 1]
    thermal    (N, 1, H, W) float in [0, 1]
    masks      cells of the image padded to multiples of 32, (N, h, w) bool each, True = the pixels
               are hidden; None: nothing is hidden
    views      what is predicted from, one of the record's; () is its first
    generator  of all that is dropped at random in training; where nothing is, it is not drawn from
    -> logits  (N, K, H, W) class scores
       aux     named intermediates; where the record says so, "features" (N, C, h, w): the last
               stage of the encoder, of the image padded at the bottom and right

ValueError: shapes that do not fit each other, or no generator where one is needed. InputError:
another view, or mask cells that do not divide the padded image.
"""
