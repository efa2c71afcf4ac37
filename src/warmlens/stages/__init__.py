"""One module a rule: read artifacts, call science, write one artifact."""
