"""Images decoded once and read from a map of memory ever after; a command and a reader."""
