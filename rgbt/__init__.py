"""A lab for RGB-thermal semantic segmentation of driving scenes.

``python -m rgbt.run +experiment=grbm`` trains a network; importing this package imports nothing
else.
"""
