"""What a person does beside a running cell: teach, look, measure, set up."""
