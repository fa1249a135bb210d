"""What the service is compared with: other ways to predict the tool, and other ways to follow."""
