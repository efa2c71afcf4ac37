"""Variants of a campaign on one observation, and how bound and scan move."""
