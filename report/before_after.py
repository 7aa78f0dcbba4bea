"""Before-and-after slider of the report: two pictures of the same view, one over the other, with a movable border.

A reader chooses the view and the kinds of pictures (`TITLES`), e.g. photograph and result.
"""

from __future__ import annotations

from html import escape
from pathlib import Path

from reffusion.io.images import image_size, load_image
from report import inline_images, page
from report.job_data import JobFiles
from report.results import load_view_scores, shows_object

MEGABYTES = 3.0  # approximate size of all pictures together
MIN_SIDE, MAX_SIDE = 320, 960  # longer side of a picture, px
TITLES = {
    "photograph": "photograph",
    "renders_fit": "with the object",
    "truth": "ground truth",
    "renders_initialize": "initialization",
    "renders": "result",
}
STYLE = """
.pair { margin: .4rem 0; max-width: 60rem } .pair[hidden] { display: none }
.stage { position: relative; overflow: hidden; background: #eee }
.stage img { position: absolute; inset: 0; width: 100%; height: 100%; margin: 0; display: none }
.stage img.left, .stage img.right { display: block } .stage img.right { clip-path: inset(0 0 0 var(--at)) }
.stage i { position: absolute; top: 0; bottom: 0; left: var(--at); width: 2px; margin-left: -1px; background: #fff }
.stage i { box-shadow: 0 0 3px #000; pointer-events: none }
.stage i::after { content: "\\2194"; position: absolute; top: 50%; left: -17px; width: 36px; height: 36px }
.stage i::after { margin-top: -18px; border-radius: 50%; background: #fff; color: #333; text-align: center }
.stage i::after { font: 22px/34px sans-serif; box-shadow: 0 0 3px #000 }
.stage input { position: absolute; inset: 0; width: 100%; height: 100%; margin: 0; opacity: 0; cursor: ew-resize }
.stage input { touch-action: pan-y } .stage input:focus-visible ~ i { outline: 3px solid #0a5a8c }
.stage b { position: absolute; bottom: .4rem; padding: 0 .4rem; background: #000a; color: #fff; pointer-events: none }
.stage b { font: .8rem/1.5 system-ui, sans-serif; max-width: 46% }
.stage b.l { left: .4rem } .stage b.r { right: .4rem }
.choose { display: flex; flex-wrap: wrap; gap: .4rem 1rem; align-items: center }
.choose select, .choose button { font: inherit; padding: .2rem .4rem; min-height: 2.2rem; max-width: 16rem }
figcaption { font-size: .85rem; color: #555 }
@media print {
  .choose, .stage input, .stage i { display: none } .stage b { position: static; color: #000; background: none }
  .stage { aspect-ratio: auto !important; background: none } .stage img { position: static; width: 49% }
  .stage img.left, .stage img.right { display: inline-block; clip-path: none; height: auto }
}
"""
SCRIPT = """
for (const box of document.querySelectorAll('.compare')) {
  const [view, left, right] = box.querySelectorAll('select');
  const pairs = [...box.querySelectorAll('.pair')];
  const show = () => {
    for (const pair of pairs) {
      pair.hidden = pair.dataset.view !== view.value;
      const images = [...pair.querySelectorAll('img')];
      const find = (kind, fallback) => images.find(i => i.dataset.kind === kind) || fallback;
      const sides = {left: find(left.value, images[0]), right: find(right.value, images[images.length - 1])};
      for (const image of images) {
        image.classList.toggle('left', image === sides.left);
        image.classList.toggle('right', image === sides.right);
      }
      pair.querySelector('b.l').textContent = sides.left.alt;
      pair.querySelector('b.r').textContent = sides.right.alt;
    }
  };
  const step = by => {
    view.selectedIndex = (view.selectedIndex + by + view.length) % view.length;
    show();
  };
  [view, left, right].forEach(choice => choice.addEventListener('change', show));
  box.querySelectorAll('button').forEach((button, k) => button.addEventListener('click', () => step(k ? 1 : -1)));
  let at = 50;
  for (const pair of pairs) pair.querySelector('input').addEventListener('input', event => {
    at = event.target.value;
    for (const each of pairs) {
      each.style.setProperty('--at', at + '%');
      each.querySelector('input').value = at;
    }
  });
  show();
}
addEventListener('beforeprint', () => document.querySelectorAll('details').forEach(each => { each.open = true; }));
"""


def before_after_section(job: JobFiles) -> list[str]:
    """Return the section as HTML parts: a heading and the slider, or a sentence that no view has been rendered yet."""
    views = {name: pictures for name in rendered_views(job) if (pictures := find_pictures(job, name))}
    top = page.heading("Before and after")
    if not views:
        return [top, page.paragraph("None yet: the stage `evaluate` renders the views.")]
    width, height = image_size(next(iter(next(iter(views.values())).values())))
    count = sum(len(pictures) for pictures in views.values())
    longest = inline_images.affordable_side(count, MEGABYTES, MIN_SIDE, MAX_SIDE, width / height)
    kinds = [kind for kind in TITLES if any(kind in pictures for pictures in views.values())]
    rows = load_view_scores(job.folders["evaluate"] / "per_view.csv")
    pairs = [
        _pair(name, pictures, rows.get(name, {}), longest, first=k == 0)
        for k, (name, pictures) in enumerate(views.items())
    ]
    choice = '<p class="choose"><label>view ' + _select(dict.fromkeys(views)) + "</label>"
    choice += '<span><button type="button" aria-label="previous view">‹</button> '
    choice += '<button type="button" aria-label="next view">›</button></span>'
    choice += "<label>left " + _select({k: TITLES[k] for k in kinds}, _left(kinds)) + "</label>"
    choice += "<label>right " + _select({k: TITLES[k] for k in kinds}, kinds[-1]) + "</label></p>"
    words = f"{job.metrics.get('rendered', f'{len(views)} views')}. Drag over the picture to compare."
    return [top, page.paragraph(words, quiet=True), f'<div class="compare">{choice}', *pairs, "</div>"]


def rendered_views(job: JobFiles) -> list[str]:
    """Return the sorted names of the views that the stage `evaluate` rendered; empty before this stage."""
    folder = job.folders.get("evaluate", Path()) / "renders"
    return sorted(path.stem for path in folder.glob("*.png")) if "evaluate" in job.folders else []


def find_pictures(job: JobFiles, name: str) -> dict[str, Path]:
    """Return the existing pictures of a view as {kind of picture, a key of `TITLES`: file}.

    The view's photograph has the key "truth" if it shows the scene without the object: if the view is a test view that
    has neither an input mask nor a mask made from clicks. Otherwise the photograph has the key "photograph".

    Args:
        job: a job whose stage `evaluate` is done.
        name: name of the view.
    """
    evaluate, poses = job.folders["evaluate"], job.folders.get("poses", Path())
    paths = {kind: evaluate / kind / f"{name}.png" for kind in TITLES}
    if (poses / "views.json").is_file():
        kind = "photograph" if shows_object(job.folders, name) else "truth"
        paths[kind] = poses / "images" / f"{name}.png"
    return {kind: path for kind, path in paths.items() if path.is_file()}


def _left(kinds: list[str]) -> str:
    """Return the kind of picture that the left side shows at first: fit, photograph or ground truth, if available."""
    # A photograph is sharper than any render, so beside one the result looks worse than the removal left it.
    return next((kind for kind in ("renders_fit", "photograph", "truth") if kind in kinds), kinds[0])


def _select(options: dict[str, str | None], chosen: str = "") -> str:
    """Return an HTML list to choose from: value -> text to show, None for the value itself."""
    lines = [
        f'<option value="{escape(value)}"{" selected" if value == chosen else ""}>{escape(words or value)}</option>'
        for value, words in options.items()
    ]
    return "<select>" + "".join(lines) + "</select>"


def _pair(name: str, pictures: dict[str, Path], row: dict[str, float], longest: int, first: bool) -> str:
    """Return a view's figure: its pictures (longer side `longest` px) in one place, a slider, a caption with scores."""
    kinds, images = list(pictures), []
    width, height = image_size(pictures[kinds[0]])
    sides = {_left(kinds): "left", kinds[-1]: "right"}
    for kind, path in pictures.items():
        side = f' class="{sides[kind]}"' if kind in sides else ""
        source = inline_images.photo_address(load_image(path), longest)
        images.append(f'<img{side} data-kind="{kind}" src="{source}" alt="{TITLES[kind]}">')
    scores = [f"{row['psnr_box']:.2f} dB in the box"] if "psnr_box" in row else []
    scores += [f"FLIP {row['flip_box']:.3f}"] if "flip_box" in row else []
    slider = f'<input type="range" min="0" max="100" value="50" aria-label="{escape(name)}: before and after"><i></i>'
    words = f'<b class="l">{TITLES[_left(kinds)]}</b><b class="r">{TITLES[kinds[-1]]}</b>'
    stage = f'<div class="stage" style="aspect-ratio: {width} / {height}">{"".join(images)}{slider}{words}</div>'
    caption = f"<figcaption>{escape(', '.join([name, *scores]))}</figcaption>"
    hidden = "" if first else " hidden"  # without JavaScript only the first view is visible
    return f'<figure class="pair" data-view="{escape(name)}" style="--at: 50%"{hidden}>{stage}{caption}</figure>'
