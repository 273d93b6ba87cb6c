"""What is said: verdict, figures, page, files."""
