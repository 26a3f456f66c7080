"""Showcases: gradients put to work, each with its success measured."""
