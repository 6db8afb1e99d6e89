"""What a finished dataset is worth: scores against truth, and one HTML page that shows them."""
