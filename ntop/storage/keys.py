"""Names of what is rendered: a set is one body pose seen by every camera of a rig."""

import hashlib
from dataclasses import dataclass


@dataclass(frozen=True)
class SetKey:
    """The key of a set; with a view it names one image."""

    source: str
    actor: str
    action: str
    rig: str
    frame: int

    def sample_id(self, view: str) -> str:
        """Identity of an image: it depends on its job key alone, not on what else is rendered."""
        key = f"{self.source}/{self.actor}/{self.action}/{self.rig}/{self.frame}/{view}"
        return hashlib.sha256(key.encode()).hexdigest()[:16]

    def image_name(self, view: str) -> str:
        """File name shared by a view's image, depth and parts, each in a folder of its own."""
        return f"{self.frame:06d}_{view}.png"

    def folder(self) -> str:
        """Where a dataset keeps the files of this sequence, below its kind and split."""
        return f"{self.source}/{self.actor}/{self.action}/{self.rig}"
