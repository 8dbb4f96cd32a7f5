"""A lab for RGB-thermal semantic segmentation of driving scenes.

``python -m rgbt.run +experiment=grbm`` is the way in; importing this package imports nothing else.
"""

__version__ = "0.1.0"  # read by the build (`tool.hatch.version`); CITATION.cff repeats it
