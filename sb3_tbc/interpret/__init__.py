"""Seeing inside a trained low level: where its neurons are active, what they follow, and what depends on them."""
