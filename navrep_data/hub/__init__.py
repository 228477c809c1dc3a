"""The Hugging Face Hub as datasets and models use it: names, revisions, checked files, commits."""
