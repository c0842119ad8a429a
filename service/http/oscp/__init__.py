"""The OSCP GeoPose protocol."""
