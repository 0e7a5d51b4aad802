"""What is sent: each payload's fields, checks and bytes."""
