"""Predicted label images of any method: found, read without guessing, counted by region.

`folder` finds the files of a split, `images` reads one, `scoring` counts them in one pass, `maps`
holds the counts by pixel, `table` derives the scores and `text` writes them out.
"""
