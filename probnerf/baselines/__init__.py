"""What the posterior is measured against."""
