"""What people see of a test while it runs: from its record, and from pictures that `live` leaves beside it."""
