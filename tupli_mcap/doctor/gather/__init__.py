"""What is measured while a recording streams past: one pass, memory that does not grow with the steps."""
