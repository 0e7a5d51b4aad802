"""Tracked boxes in the field's file formats: one format per file, one policy for all of them."""
