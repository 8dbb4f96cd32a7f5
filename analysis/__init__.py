"""What the results mean: spatial statistics, intervals and tests, figures, the report.

Reads data sets, counts and what runs have stored; never a network.
"""
