"""Read videos of RGB-thermal frames, of which all, some or none are labelled."""
