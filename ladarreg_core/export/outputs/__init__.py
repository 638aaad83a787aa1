"""What earlier commands wrote: recognized, checked and opened again."""
