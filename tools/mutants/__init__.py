"""Mutation testing: does any test fail when a small part of the code is changed?"""
