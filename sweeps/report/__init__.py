"""What a study has found: tables, figures, and records in MLflow."""
