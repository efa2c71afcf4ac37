"""What an auditor reads: every file checked, the manifest, the RO-Crate."""
