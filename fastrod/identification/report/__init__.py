"""Reports: verdict, figures, page, files."""
