"""Notes on imagery, which state assumptions, repairs and omissions."""


class ImageNote(str):
    """A note on one image; as text it begins with the image's name and a colon.

    Attributes:
        image: the image's name.
        told: the note without it.
    """

    image: str
    told: str

    def __new__(cls, image: str, told: str) -> "ImageNote":
        note = super().__new__(cls, f"{image}: {told}")
        note.image, note.told = image, told
        return note
