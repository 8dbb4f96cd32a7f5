"""Pages of results, the report of a study, and records in MLflow."""
