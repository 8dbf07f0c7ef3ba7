"""What a rendered view is held against."""
