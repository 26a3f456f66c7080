"""Ground floor: arrays that are checked, frozen, scattered and differenced."""
