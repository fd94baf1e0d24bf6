"""Wrong values of options: one message, before any work."""
