"""Selection of points: grids of comma lists, ranges of a search, samplers and pruners."""
