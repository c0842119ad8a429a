"""Locks the packages of the images, checks their licences and lists their parts."""
