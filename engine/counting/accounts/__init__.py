"""What is reported of a count: audit, description, ids, intervals and the review."""
