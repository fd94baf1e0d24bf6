"""What happens before the first training step, and what it costs."""
