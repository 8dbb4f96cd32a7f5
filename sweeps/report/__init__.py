"""Report of a study: tables, figures, and records in MLflow."""
