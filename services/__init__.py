"""The services: gateway, tracking and mapping. They meet only through `shared`."""
