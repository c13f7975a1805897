"""What networks learn from: scenes solved by teachers, in shards that a stopped run continues."""
