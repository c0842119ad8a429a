"""ORB and thumbnails as features for visloc."""
