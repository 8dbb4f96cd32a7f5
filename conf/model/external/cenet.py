"""CENet with random weights instead of ImageNet's; the argument is spelt so in the code."""

import torchvision

from rgbt.models.external.adapting import Untrained, replace_in


def network(n_class, trianing_style):
    """Build the network."""
    from TSmodel.Teacher_model import Teacher_model

    replace_in(Teacher_model, models=Untrained(torchvision.models))
    return Teacher_model(n_class, trianing_style)
