"""What an FMU tells tools and people: model description, documentation, icon, response.

The same for both backends.
May import what makes blocks; knows no backend.
"""
