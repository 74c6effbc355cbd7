"""Mask files, scene folders, Drake label images, and their rendering."""
