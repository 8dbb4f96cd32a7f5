"""Read a user's own RGB-thermal data, described by one YAML file."""
