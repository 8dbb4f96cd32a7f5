"""A lab for RGB-thermal semantic segmentation of driving scenes.

``python -m rgbt.run +experiment=grbm`` is the way in; importing this package imports nothing else.
"""

import os

# Read when torch loads. A run has a fixed number of threads (trainer.threads), so that it may share
# its cores with others: threads that wait for each other in a loop would take these cores away.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
