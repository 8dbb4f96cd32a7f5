"""DFormer, whose decoder moves its random bases to the GPU."""

from rgbt.models.external.adapting import allow_cpu


def network(cfg):
    """Build the network."""
    allow_cpu()
    from models.builder import EncoderDecoder

    return EncoderDecoder(cfg)
