"""What a data set holds and what is wrong with it; `rgbt.data.check` prints it."""
