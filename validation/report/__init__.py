"""What is shown of one measurement: figures, sentences, and a self-contained page."""
