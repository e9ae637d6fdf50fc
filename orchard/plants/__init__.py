"""Trees: skeleton, leaves and fruit."""
