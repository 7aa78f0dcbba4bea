"""Scenes that are videos: extraction of the frames into a folder, which is then used as the scene."""

import subprocess
from pathlib import Path

from runner import Refused, say
from runner.files import list_files, read_json
from runner.keys import Hashes
from runner.process import start_worker
from runner.text import display_path

FRAMES = "frames"  # name of the folder of frames in runs/<video>/
FRAME_FILES = ("frames.json", "frames.csv")  # files that the extraction writes to this folder, beside images/


def update_frames(video: Path, folder: Path, root: Path, hashes: Hashes) -> None:
    """Extract a video's frames into the folder of a scene, unless the folder has frames of a video of this content.

    Args:
        video: the video.
        folder: the folder to fill.
        root: folder with pipeline.yaml and stages/.
        hashes: the cache of hashes; the video's hash decides whether its frames are up to date.

    Raises:
        Refused: the video is not usable, or the folder has frames of another video, or the video has changed and the
            folder has files that people added for the earlier frames.
    """
    content, found = hashes.file(video), read_json(folder / FRAME_FILES[0]) or {}
    if found.get("content") == content:
        return
    ours = [folder / name for name in FRAME_FILES]
    others = [path for path in list_files(folder) if path not in ours and path.parent != folder / "images"]
    if found and (others or found["video"] != str(video)):
        of = f"frames of another video, {found['video']} as it was"
        of += f", and {display_path(others[0])} for them" if others else ""
        raise Refused(f"{display_path(folder)} holds {of}; rename the video, or move that folder away")
    module = "reffusion.capture.video_frames"  # in a process of its own, since it imports heavy modules
    process = start_worker(root, str(video), str(folder), content, module=module, stdout=subprocess.PIPE)
    message, _ = process.communicate()
    if process.returncode:
        raise Refused(message.strip() or f"{video}: its frames could not be taken (see above)")
    say(message.strip())
