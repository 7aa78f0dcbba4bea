'use strict';
const $ = id => document.getElementById(id);
const STEPS = {photographs: 'Photographs', object: 'Object', start: 'Start', live: 'Live 3D', result: 'Result', paint: 'Paint', export: 'Export'};
let scene = '', step = 'photographs', state = null, source = null, shownView = '', shown = {}, command = 'make app';

// What a stage does, for people who do not know the method: a sentence, and in a word or two.
const MEANING = {
  poses: ['finds where the photographs were taken', 'cameras'], raw_masks: ['reads the masks', 'masks'],
  fit: ['builds the scene in 3D, with the object', '3D scene'],
  masks: ['finds all of the object in 3D, and what is known behind it', 'object in 3D'],
  reference: ['completes one picture of the hole', 'picture of the hole'],
  lift: ['completes every picture (for comparisons only)', 'pictures'],
  initialize: ['removes the object and fills the hole in 3D', 'filling'],
  personalize: ['adapts the image model to the scene', 'image model'], distill: ['refines the filling', 'refining'],
  finish: ['writes the finished scene', 'finishing'], evaluate: ['renders the result from all views', 'rendering'],
};
const sentence = stage => (MEANING[stage] || [`runs ${stage}`])[0];
const at = path => `scenes/${encodeURIComponent(scene)}/${path}`;
const picture = (kind, view) => at(`pictures/${kind}/${encodeURIComponent(view)}?${state.version}`);
const isBusy = () => state && ['running', 'elsewhere'].includes(state.job.state);

async function ask(path, body) {
  const answer = await fetch(path, body === undefined ? {} : {method: 'POST', body: body instanceof Blob ? body : JSON.stringify(body)});
  const found = await answer.json().catch(() => ({error: answer.statusText}));
  if (!answer.ok) throw Object.assign(new Error(found.error), {status: answer.status});
  return found;
}

function make(tag, words = '', attributes = {}) {
  const element = Object.assign(document.createElement(tag), attributes);
  element.append(words);
  return element;
}

function complain(id, error) {
  $(id).textContent = error ? error.message || error : '';
  $(id).hidden = !error;
}

function duration(seconds) {
  if (seconds == null) return '';
  if (seconds < 90) return `${Math.max(5, 5 * Math.round(seconds / 5))} s`;
  return seconds < 5400 ? `${Math.round(seconds / 60)} min` : `${(seconds / 3600).toFixed(1)} h`;
}

// Redraw a part only when its data has changed: buttons must not vanish under the pointer.
function changed(key, value) {
  const text = JSON.stringify(value);
  if (shown[key] === text) return false;
  shown[key] = text;
  return true;
}

// ------------------------------------------------------------------------------------------------ address, steps

function go(toStep, toScene = scene) { location.hash = toScene ? `${encodeURIComponent(toScene)}/${toStep}` : ''; }

async function route() {
  const [name, wanted] = location.hash.slice(1).split('/').map(decodeURIComponent);
  step = wanted in STEPS ? wanted : 'photographs';
  if ((name || '') !== scene) {
    scene = name || '';
    state = null;
    shown = {};
    shownView = '';
    closeFrame('mask');
    closeFrame('viewer');
    if (source) source.close();
    source = null;
    if (scene) follow();
  }
  if (!scene) { step = 'photographs'; showRecent(); }
  draw();
}

// A frame without its `src` goes on showing its page; a new one does not.
function closeFrame(id) {
  const frame = $(id).cloneNode();
  frame.removeAttribute('src');
  frame.hidden = true;
  $(id).replaceWith(frame);
}

function follow() {
  source = new EventSource(at('events'));
  source.onmessage = event => { state = JSON.parse(event.data); command = state.command; $('lost').hidden = true; draw(); };
  source.onerror = async () => {
    const own = source;
    try {
      await ask(at('state'));
    } catch (error) {
      if (source !== own) return;
      if (error.status) {  // another program: it has another token, or knows no open scenes
        source.close();
        source = null;
      }
      if (error.status === 404) reopen();
      else {
        $('lost').replaceChildren(error.status ? 'The program of this page was started again. Open the address that it printed.' :
          'The program of this page has stopped; nothing is lost. Start it again with ', ...(error.status ? [] : [make('code', command), ', and open the address that it prints.']));
        $('lost').hidden = false;
        if (error.status) closeFrame('mask');
      }
    }
  };
}

// The server was started again and knows no open scenes.
async function reopen() {
  const known = (await ask('scenes')).scenes.find(each => each.name === scene);
  try {
    await ask('scenes', {path: state ? state.source : known ? known.path : scene});
    shown = {};
    closeFrame('mask');
    follow();
  } catch { go('photographs', ''); }
}

function drawSteps() {
  const done = state ? {
    photographs: state.pictures.length > 0, object: state.masks > 0 || state.brings_masks, start: Boolean(state.result) && state.plan.stages.length > 0 && !state.plan.due.length,
    result: Boolean(state.result), live: false, paint: state.to_paint.some(each => each.painted), export: !state.export.work && Object.keys(state.export.files).length > 1,
  } : {};
  const closed = {object: !state, start: !state, live: !state || !state.has_state, result: !state || !state.result,
    paint: !state || !state.result, export: !state || !state.result};
  if (!changed('steps', [scene, step, done, closed, isBusy()])) return;
  $('steps').replaceChildren(...Object.entries(STEPS).map(([name, title], k) => {
    const link = make('a', '', {href: scene ? `#${encodeURIComponent(scene)}/${name}` : '#'});
    const busy = name === 'start' && isBusy();
    link.className = busy ? 'busy' : done[name] ? 'done' : '';
    link.append(make('i', busy ? '▸' : done[name] ? '✓' : `${k + 1}`), title);
    if (name === step) link.setAttribute('aria-current', 'step');
    if (closed[name]) link.setAttribute('aria-disabled', 'true');
    return link;
  }));
  const current = $('steps').querySelector('[aria-current]');
  if (current) $('steps').scrollLeft = current.offsetLeft - $('steps').clientWidth / 2 + current.clientWidth / 2;
}

function draw() {
  for (const name in STEPS) $(name).classList.toggle('shown', name === step);
  drawSteps();
  $('scene').textContent = scene;
  document.title = scene ? `${scene} – RefFusion` : 'RefFusion';
  for (const id of ['open', 'drop', 'recent']) $(id).hidden = Boolean(scene);
  $('capture').hidden = !scene || !state;
  drawPill();
  if (state) ({photographs: drawPhotographs, object: drawObject, start: drawStart, live: drawLive, result: drawResult,
    paint: drawPaint, export: drawExport})[step]();
}

function drawPill() {
  $('pill').hidden = !isBusy();
  if (!isBusy()) return;
  const {stage, share, left} = state.job, name = stage ? MEANING[stage] ? MEANING[stage][1] : stage : 'planning';
  $('pill').href = `#${encodeURIComponent(scene)}/start`;
  $('pill').textContent = `${name}${share != null ? ` ${Math.round(100 * share)} %` : ''}${left ? `, ${duration(left)} left` : ''}`;
}

// ------------------------------------------------------------------------------------------------ photographs

async function showRecent() {
  let scenes, first;
  try {
    ({scenes, first, command} = await ask('scenes'));
  } catch (error) { complain('wrong', error); return; }
  if (first && !sessionStorage.begun) { sessionStorage.begun = 1; go('photographs', first); return; }
  const words = {finished: 'finished', begun: 'begun', new: 'not begun'};
  $('recent').replaceChildren(...(scenes.length ? [make('h3', 'Recent scenes')] : []), ...scenes.map(each => {
    const button = make('button', make('span', each.name));
    button.append(make('small', words[each.state] + (each.lost ? '; photographs moved away' : '')));
    button.title = each.path;
    button.addEventListener('click', () => open(each.path));
    return button;
  }));
}

async function open(path) {
  complain('wrong');
  try {
    const {name} = await ask('scenes', {path});
    go('photographs', name);
  } catch (error) { complain('wrong', error); }
}

function drawPhotographs() {
  const {pictures, plan} = state, masks = state.masks || state.brings_masks;
  $('captured').textContent = pictures.length ? `${pictures.length} photographs` : 'No photographs yet';
  $('source').textContent = state.source;
  if (changed('found', state.found)) $('found').replaceChildren(...state.found.map(words => make('li', words)));
  const doubts = [...(plan.error && !plan.busy ? [plan.error] : []), ...state.doubts];
  $('doubts').hidden = !doubts.length;
  if (changed('doubts', doubts)) {
    $('doubts').firstChild.textContent = `${doubts.length} doubt${doubts.length === 1 ? '' : 's'}`;
    $('doubts').lastChild.replaceChildren(...doubts.map(words => make('li', words)));
    $('doubts').open = doubts.length > 0 && doubts.length < 4;
  }
  $('checking').textContent = plan.busy ? 'looking at the capture …' : '';
  const ends = state.lost && state.result;
  $('next').hidden = !pictures.length || (state.lost && !ends);
  $('next').textContent = ends ? 'Look at the result' : masks ? 'Next: start the job' : 'Next: mark the object';
  $('next').href = `#${encodeURIComponent(scene)}/${ends ? 'result' : masks ? 'start' : 'object'}`;
  $('next').onclick = masks || ends ? null : wantMasks;
  drawThumbnails('thumbnails', pictures, true);
}

function drawThumbnails(id, names, named) {
  if (!changed(id, [names, state.version])) return;
  $(id).replaceChildren(...names.map(name => {
    const figure = make('figure');
    figure.append(make('img', '', {src: picture('small', name), loading: 'lazy', alt: name}), named ? name : '');
    return figure;
  }));
}

$('open').addEventListener('submit', event => {
  event.preventDefault();
  open($('path').value);
});
$('files').addEventListener('change', () => upload([...$('files').files], ''));
for (const kind of ['dragover', 'dragleave', 'drop']) $('drop').addEventListener(kind, event => {
  event.preventDefault();
  $('drop').classList.toggle('over', kind === 'dragover');
  if (kind === 'drop') collect(event.dataTransfer);
});
$('drop').addEventListener('keydown', event => { if (event.key === 'Enter' || event.key === ' ') $('files').click(); });

// Files of a drop; of a folder, those directly in it.
async function collect(transfer) {
  const entries = [...transfer.items].map(item => item.webkitGetAsEntry && item.webkitGetAsEntry()).filter(Boolean);
  const folder = entries.find(each => each.isDirectory);
  if (!folder) { upload([...transfer.files], ''); return; }
  const reader = folder.createReader(), found = [];
  for (;;) {
    const some = await new Promise((resolve, reject) => reader.readEntries(resolve, reject));
    if (!some.length) break;
    found.push(...some.filter(each => each.isFile));
  }
  upload(await Promise.all(found.map(each => new Promise((resolve, reject) => each.file(resolve, reject)))), folder.name);
}

async function upload(files, folder) {
  complain('wrong');
  const usable = files.filter(file => !file.name.startsWith('.'));
  if (!usable.length) return;
  const name = folder || prompt('Name of the new scene', usable.length === 1 ? usable[0].name.replace(/\.[^.]*$/, '') : 'my-photos');
  if (!name) return;
  $('uploading').hidden = false;
  const refused = [];
  let path = null;
  try {
    const {name: place} = await ask('uploads', {name});
    for (const [k, file] of usable.entries()) {
      $('uploading').textContent = `copying ${k + 1} of ${usable.length}: ${file.name}`;
      try {
        ({path} = await ask(`uploads/${encodeURIComponent(place)}/${encodeURIComponent(file.name)}`, file));
      } catch (error) { if (!error.status) throw error; refused.push(error.message); }
    }
  } catch (error) { refused.push(error.message); }
  $('uploading').hidden = true;
  if (path) await open(path);
  if (refused.length) complain('wrong', `left out: ${refused.slice(0, 3).join('; ')}${refused.length > 3 ? ` and ${refused.length - 3} more` : ''}`);
}

// ------------------------------------------------------------------------------------------------ object

let asked = 0;

function drawObject() {
  const open = !$('mask').hidden, {job, masks, has_poses: ready} = state;
  const ask_ = $('mask').dataset.wanted === scene;
  $('masked').hidden = open || !masks;
  $('object').classList.toggle('marking', open);
  $('method').textContent = state.has_network ? 'Clicks: a segmentation network finds the object around a click.' :
    'Clicks: colors and surfaces decide what belongs to the object. With the network that `make weights` fetches (37 MB) fewer clicks are enough.';
  $('halted').hidden = !(open && state.awaits_fit && !isBusy() && !state.lost);
  if (open) {
    $('object-progress').replaceChildren();
    $('object-buttons').replaceChildren();
    return;
  }
  if ((masks || state.brings_masks) && !ask_) {
    $('object-lead').textContent = `${masks ? `${masks} ${masks === 1 ? 'photograph has' : 'photographs have'} a mask` : 'The scene brings masks'}. Go on, or change the masks by clicks.`;
    if (changed('object', 'masks')) {
      const change = make('button', 'Change the masks');
      change.addEventListener('click', wantMasks);
      $('object-buttons').replaceChildren(make('a', 'Next: start the job', {className: 'button main', href: `#${encodeURIComponent(scene)}/start`}), change);
    }
    if (masks) drawThumbnails('masked', state.pictures, true);
    return;
  }
  if (!ask_) {
    $('object-lead').textContent = 'The photographs are prepared first; then you mark the object here, while the scene is fitted.';
    if (changed('object', 'begin')) {
      const begin = make('button', 'Mark the object', {className: 'main'});
      begin.addEventListener('click', wantMasks);
      $('object-buttons').replaceChildren(begin);
    }
    return;
  }
  if (changed('object', 'waits')) $('object-buttons').replaceChildren();
  if (state.lost) { $('object-lead').textContent = state.lost; return; }
  if ((ready || !isBusy()) && Date.now() - asked > 3000) wantMasks();
  if (isBusy()) {
    $('object-lead').textContent = job.state === 'elsewhere' ? `${job.words}.` : 'Preparing the photographs. The page for clicks opens by itself.';
    const bar = $('object-progress').firstChild || $('object-progress').appendChild(make('progress', '', {max: 1}));
    if (job.share != null) bar.value = job.share; else bar.removeAttribute('value');
  }
}

async function wantMasks() {
  asked = Date.now();
  $('mask').dataset.wanted = scene;
  try {
    const {open} = await ask(at('do/mask'), {});
    if (open) {
      $('mask').src = at('mask/');
      $('mask').hidden = false;
      } else if (state.job.state === 'failed') throw new Error(`The cameras were not found: ${state.job.words}`);
    draw();
  } catch (error) {
    $('mask').dataset.wanted = '';
    shown.object = '';
    draw();
    $('object-lead').textContent = error.message;
  }
}

// ------------------------------------------------------------------------------------------------ start

// The photographs were being prepared for the step Object when the job ended.
const wasPreparing = () => state.lacks_masks && ['stopped', 'failed'].includes(state.job.state) && state.job.target !== 'all';

function drawStart() {
  const {job, plan} = state, due = plan.due.length, running = job.state === 'running', resumes = wasPreparing();
  const isDone = !due && Boolean(state.result) && !isBusy() && !plan.busy;
  $('run').hidden = isBusy() || (isDone && !state.lacks_masks);
  $('run').disabled = Boolean(state.lost) || plan.busy || (!resumes && (Boolean(plan.error) || state.lacks_masks || !due));
  $('run').textContent = job.state === 'stopped' || job.state === 'failed' ? 'Go on' : 'Start';
  $('halt').hidden = !running;
  $('qualities').hidden = !plan.quality || isBusy() || state.lacks_masks || Boolean(state.lost);
  if (!plan.busy && changed('quality', plan.quality)) $('quality').value = plan.quality;
  $('look').hidden = !state.result || isBusy() || !(isDone || state.lost);
  $('look').href = `#${encodeURIComponent(scene)}/result`;
  $('bar').hidden = !isBusy();
  if (job.whole != null) $('bar').value = job.whole; else $('bar').removeAttribute('value');
  let lead = '';
  if (job.state === 'elsewhere') lead = `${job.words}.`;
  else if (running && job.target !== 'all') lead = `Preparing the step Object: the program ${job.stage ? sentence(job.stage) : 'plans what to do'}.${state.has_poses ? ' You can mark the object there meanwhile.' : ''}`;
  else if (running) lead = job.stage ? `Now the program ${sentence(job.stage)}.` : 'Now the program plans the next step.';
  else if (state.lost) lead = state.lost;
  else if (job.state === 'failed') lead = `The job failed: ${job.words}`;
  else if (plan.busy) lead = 'Looking at what has to run …';
  else if (resumes) lead = 'Preparing the photographs was stopped. Go on from there; you can mark the object meanwhile.';
  else if (state.lacks_masks && state.has_unsaved_marks) lead = 'Your marks are not saved yet: save the masks in the step Object.';
  else if (state.lacks_masks) lead = 'The object is not marked yet: go to the step Object.';
  else if (plan.error) lead = plan.error;
  else if (isDone) lead = 'Everything is done.';
  else if (job.state === 'stopped') lead = job.words;
  else lead = state.result ? 'Something changed. Start runs the steps again that depend on it.' : 'Builds the scene in 3D, removes the object, and fills the hole. You may close this page meanwhile.';
  $('start-lead').textContent = lead;
  $('start-lead').classList.toggle('wrong', !isBusy() && !plan.busy && (Boolean(state.lost) || (!resumes && (job.state === 'failed' || Boolean(plan.error)))));
  $('total').textContent = isBusy() ? (job.left ? `about ${duration(job.left)} left` : '') :
    due && !plan.busy && !plan.error && plan.seconds ? `about ${duration(plan.seconds)} in all` : '';
  if (changed('stages', [plan.stages, job.stage, job.done])) {
    $('stages').tBodies[0].replaceChildren(...plan.stages.map(each => {
      const done = ['cached', 'provided'].includes(each.word) || job.done.includes(each.name);
      const kind = each.name === job.stage ? 'running' : done ? 'done' : each.word === 'skip' ? 'skip' : each.word === 'missing' ? 'missing' : '';
      const row = make('tr', '', {className: kind, title: [each.name, each.reason].filter(Boolean).join(': ')});
      const what = make('td', sentence(each.name));
      const why = kind === 'missing' ? each.reason : kind === 'skip' ? 'not needed for this scene' :
        done || /^(not run yet|waits for|left out if)/.test(each.reason) || !each.reason ? '' : 'runs again, because something that it depends on changed';
      if (why) what.append(make('small', why));
      row.append(what, make('td', done || kind === 'skip' ? '' : duration(each.seconds)));
      return row;
    }));
  }
  $('log').hidden = !job.log.length;
  if (changed('log', job.log)) {
    const pre = $('log').lastElementChild;
    pre.textContent = job.log.join('\n');
    pre.scrollTop = pre.scrollHeight;
  }
}

const act = (name, id = 'start-lead', body = {}) => ask(at(`do/${name}`), body).catch(error => { $(id).textContent = error.message; });
$('run').addEventListener('click', () => {
  if (wasPreparing()) { $('run').disabled = true; act('mask'); return; }
  if (state.has_unsaved_marks && !confirm('Your last marks are not in the saved masks. Start without them? (To use them, save the masks in the step Object.)')) return;
  $('run').disabled = true;
  act('start');
});
$('quality').addEventListener('change', () => act('quality', 'start-lead', {profile: $('quality').value}));
$('resume').addEventListener('click', () => act('mask', 'method'));
$('halt').addEventListener('click', async () => {
  $('halt').disabled = true;
  $('start-lead').textContent = 'Stopping …';
  await act('stop');
  $('halt').disabled = false;
});

// ------------------------------------------------------------------------------------------------ live 3D

async function drawLive() {
  const follows = isBusy() || !state.result;
  if (!state.has_viewer) {
    $('live-lead').replaceChildren('The 3D view needs one more package: ', make('code', "pip install viser"), ', then start this page again. Below is the latest picture.');
    const view = state.pictures[Math.floor(state.pictures.length / 2)];
    if (view && changed('still', [view, state.version])) {
      $('still').src = picture(state.result ? 'result' : 'photo', view);
      $('still').hidden = false;
    }
    return;
  }
  if (!state.has_state) { $('live-lead').textContent = 'The 3D view opens when the scene is built in 3D, with the object.'; return; }
  if (!changed('live', follows)) return;
  $('live-lead').textContent = 'The viewer starts …';
  try {
    const {port} = await ask(at('live'), {});
    $('viewer').src = `http://${location.hostname}:${port}/`;
    $('viewer').hidden = false;
    $('live-lead').textContent = follows ? 'The scene as it is now; it reloads when there is a newer state. Drag to turn, wheel to zoom.' : 'The finished scene. Drag to turn, wheel to zoom.';
  } catch (error) { $('live-lead').textContent = error.message; }
}

// ------------------------------------------------------------------------------------------------ result

function drawResult() {
  const {result} = state;
  $('compare').hidden = $('remedies').hidden = !result;
  const words = !result ? ['The result comes at the end of the job.'] : result.verdict.length ? result.verdict : ['The scene is finished.'];
  if (changed('verdict', words)) $('verdict').replaceChildren(...words.map(each => make('p', each)));
  if (!result) return;
  $('correct').href = `#${encodeURIComponent(scene)}/object`;
  $('complete').href = `#${encodeURIComponent(scene)}/paint`;
  $('against').parentElement.hidden = !result.has_fit;
  if (!result.has_fit) $('against').value = 'photo';
  $('filled').textContent = result.is_painted ? 'from the picture that you gave' : 'made up in one picture, and used for all views';
  if (changed('views', result.views)) $('view').replaceChildren(...result.views.map(name => make('option', name)));
  if (!result.views.includes(shownView)) choose(result.views.find(name => result.rendered.includes(name)) || result.views[0]);
  else if (changed('compared', [shownView, state.version])) choose(shownView);
}

function choose(name) {
  shownView = name;
  changed('compared', [shownView, state.version]);
  $('view').value = name;
  const kind = $('against').value;
  $('before').src = picture(kind, name);
  $('slider').querySelector('b.l').textContent = $('before').alt = kind === 'photo' ? 'photograph' : 'with the object';
  $('after').src = picture('result', name);
  $('overlay').src = picture('unsure', name);
}

function move(by) {
  const {views} = state.result;
  choose(views[(views.indexOf(shownView) + by + views.length) % views.length]);
}

// The pictures on the slider: magnification, and the place of their upper left corner in px; and fingers on them.
const MOST_ZOOM = 16, NEAR = 28;  // px around the line in which a press moves it
let zoom = 1, corner = [0, 0], line = 0.5, grip = null;
const fingers = new Map();

function placePictures() {
  const box = $('slider').getBoundingClientRect(), sides = [box.width, box.height];
  zoom = Math.min(Math.max(zoom, 1), MOST_ZOOM);
  corner = corner.map((place, k) => Math.min(0, Math.max(place, sides[k] * (1 - zoom))));
  $('slider').style.setProperty('--view', zoom > 1 ? `translate(${corner[0]}px, ${corner[1]}px) scale(${zoom})` : 'none');
  $('slider').classList.toggle('zoomed', zoom > 1);
  $('slider').style.setProperty('--at', `${100 * line}%`);
  $('slider').querySelector('input').value = 1000 * line;
}

// Magnify about a point of the slider, in px; without one about its center.
function magnify(factor, point) {
  const box = $('slider').getBoundingClientRect(), [x, y] = point || [box.width / 2, box.height / 2];
  const before = zoom;
  zoom = Math.min(Math.max(zoom * factor, 1), MOST_ZOOM);
  corner = [x - (x - corner[0]) * zoom / before, y - (y - corner[1]) * zoom / before];
  placePictures();
}

function onSlider(event) {
  const box = $('slider').getBoundingClientRect();
  return [event.clientX - box.left, event.clientY - box.top];
}

function press(event) {
  if (event.button) return;
  const [x, y] = onSlider(event), width = $('slider').clientWidth;
  $('slider').setPointerCapture(event.pointerId);
  fingers.set(event.pointerId, [x, y]);
  const moves_line = fingers.size === 1 && (zoom === 1 || Math.abs(x - line * width) < NEAR);
  grip = fingers.size > 1 ? 'pinch' : moves_line ? 'line' : 'pictures';
  if (grip === 'line') drag(event);
}

function drag(event) {
  const last = fingers.get(event.pointerId), now = onSlider(event);
  if (!last) return;
  const distance = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]) || 1; };
  const before = fingers.size > 1 ? distance() : 1;
  fingers.set(event.pointerId, now);
  if (grip === 'line') line = Math.min(Math.max(now[0] / $('slider').clientWidth, 0), 1);
  else if (grip === 'pictures') corner = corner.map((place, k) => place + now[k] - last[k]);
  else if (fingers.size > 1) {
    const [a, b] = [...fingers.values()];
    magnify(distance() / before, [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2]);
  }
  placePictures();
}

function release(event) {
  fingers.delete(event.pointerId);
  if (!fingers.size) grip = null;
}

$('slider').addEventListener('pointerdown', press);
$('slider').addEventListener('pointermove', drag);
for (const name of ['pointerup', 'pointercancel']) $('slider').addEventListener(name, release);
$('slider').addEventListener('wheel', event => {
  event.preventDefault();
  magnify(Math.exp(-event.deltaY * (event.deltaMode ? 33 : 1) / 400), onSlider(event));
}, {passive: false});
$('larger').addEventListener('click', () => magnify(1.6));
$('smaller').addEventListener('click', () => magnify(1 / 1.6));
$('whole').addEventListener('click', () => magnify(0));
$('full').hidden = !$('compare').requestFullscreen;
$('full').addEventListener('click', () => document.fullscreenElement ? document.exitFullscreen() : $('compare').requestFullscreen());
document.addEventListener('fullscreenchange', () => {
  $('full').textContent = document.fullscreenElement ? 'Leave full screen' : 'Full screen';
  placePictures();
});
addEventListener('resize', placePictures);
$('before').addEventListener('load', () => {
  $('slider').style.setProperty('--ratio', $('before').naturalWidth / $('before').naturalHeight);
  placePictures();
});
$('view').addEventListener('change', () => choose($('view').value));
$('against').addEventListener('change', () => choose(shownView));
$('previous').addEventListener('click', () => move(-1));
$('following').addEventListener('click', () => move(1));
$('slider').querySelector('input').addEventListener('input', event => { line = event.target.value / 1000; placePictures(); });
$('unsure').addEventListener('change', () => { $('overlay').hidden = $('legend').hidden = !$('unsure').checked; });
addEventListener('keydown', event => {
  if (step !== 'result' || !state || !state.result || event.target.tagName === 'SELECT' || event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.key === 'ArrowLeft') move(-1);
  else if (event.key === 'ArrowRight') move(1);
  else return;
  event.preventDefault();
});

// ------------------------------------------------------------------------------------------------ paint

function drawPaint() {
  const views = state.to_paint;
  $('paint-lead').textContent = views.length ?
    'The gray part is what no photograph shows. Paint it here. Or download the picture, paint the gray part with any program without cropping the picture, and upload it. The next Start uses your picture.' :
    'Nothing has to be painted: the photographs show everything behind the object, or scene.yaml names a reference picture.';
  if (!changed('paint', [views, state.version])) return;
  $('paintings').replaceChildren(...views.map((each, k) => {
    const address = at(`paint/${encodeURIComponent(each.view)}`), figure = make('figure'), row = make('p', '', {className: 'row'});
    const file = make('input', '', {type: 'file', accept: 'image/png,image/jpeg,image/webp', hidden: true});
    const button = make('button', each.painted ? 'Upload another' : 'Upload');
    button.addEventListener('click', () => file.click());
    file.addEventListener('change', () => paint(address, file.files[0]));
    const share = `${Math.round(100 * each.share)} %`, picture_ = each.painted ? `${address}/painted?${each.painted}` : `${address}?${state.version}`;
    const words = `${each.view}: ${k ? 'another ' : ''}${share} of the missing part can be painted in this view.${each.painted ? ' You painted it.' : ''}`;
    const here = make('button', 'Paint here', {className: 'main'});
    here.addEventListener('click', () => beginPainting(address));
    row.append(here, make('a', 'Download', {className: 'button', href: address, download: `${each.view}.png`}), button, file);
    figure.append(make('img', '', {src: picture_, alt: `${each.view}, ${each.painted ? '' : 'to be '}painted`, loading: 'lazy'}), make('p', words), row);
    return figure;
  }));
}

async function paint(address, file, replace = false) {
  if (!file) return;
  complain('paint-wrong');
  try {
    await ask(address + (replace ? '?replace=1' : ''), file);
    go('start');
  } catch (error) {
    if (error.status === 409 && confirm(`${error.message}. Replace it?`)) paint(address, file, true);
    else if (error.status !== 409) complain('paint-wrong', error);
  }
}

// The picture on the easel: its address, earlier pictures for Undo, the last marked part, and the seed of its filling.
let easel = null;
const board = $('canvas').getContext('2d'), marks = $('marks').getContext('2d', {willReadFrequently: true});

async function beginPainting(address) {
  complain('paint-wrong');
  try {
    const image = await createImageBitmap(await fetchPicture(`${address}/canvas`));
    for (const each of [$('canvas'), $('marks')]) { each.width = image.width; each.height = image.height; }
    board.drawImage(image, 0, 0);
    $('brush').value = Math.round(image.width / 16);
    easel = {address, earlier: [], last: null, seed: 0, marked: false};
    drawEasel();
  } catch (error) { complain('paint-wrong', error); }
}

async function fetchPicture(address, body) {
  const answer = await fetch(address, body ? {method: 'POST', body} : {});
  if (!answer.ok) throw new Error((await answer.json()).error);
  return answer.blob();
}

function drawEasel(busy = false) {
  $('painter').hidden = !easel;
  $('paintings').hidden = Boolean(easel);
  if (!easel) return;
  $('fill').disabled = busy || !easel.marked;
  $('again').disabled = busy || !easel.last;
  $('undo').disabled = busy || !(easel.marked || easel.earlier.length);
  $('use').disabled = busy || !easel.earlier.length;
  $('filling').textContent = busy ? 'filling …' : '';
}

function stroke(event) {
  if (!easel || !(event.buttons & 1)) return;
  const box = $('marks').getBoundingClientRect(), scale = $('marks').width / box.width;
  const [x, y] = [(event.clientX - box.left) * scale, (event.clientY - box.top) * scale];
  if (event.type === 'pointerdown') { $('marks').setPointerCapture(event.pointerId); easel.at = [x, y]; }
  Object.assign(marks, {lineWidth: Number($('brush').value), lineCap: 'round', strokeStyle: '#f0f'});
  marks.beginPath();
  marks.moveTo(...(easel.at || [x, y]));
  marks.lineTo(x, y + .01);
  marks.stroke();
  Object.assign(easel, {at: [x, y], marked: true});
  drawEasel();
}

async function fillMarked() {
  const {width, height} = $('canvas'), cut = make('canvas', '', {width, height}), pen = cut.getContext('2d');
  pen.drawImage(easel.last.picture, 0, 0);
  pen.globalCompositeOperation = 'destination-out';
  pen.drawImage(easel.last.marks, 0, 0);
  drawEasel(true);
  try {
    const body = await new Promise(done => cut.toBlob(done, 'image/png'));
    board.drawImage(await createImageBitmap(await fetchPicture(`${easel.address}/fill?seed=${easel.seed}`, body)), 0, 0);
    marks.clearRect(0, 0, width, height);
    if (!easel.seed) easel.earlier.push(easel.last.picture);
    easel.marked = false;
  } catch (error) { complain('paint-wrong', error); }
  drawEasel();
}

async function copyCanvas(id) { return createImageBitmap($(id)); }

for (const name of ['pointerdown', 'pointermove']) $('marks').addEventListener(name, stroke);
$('marks').addEventListener('pointerup', () => { if (easel) easel.at = null; });
$('fill').addEventListener('click', async () => {
  Object.assign(easel, {last: {picture: await copyCanvas('canvas'), marks: await copyCanvas('marks')}, seed: 0});
  fillMarked();
});
$('again').addEventListener('click', () => { easel.seed += 1; fillMarked(); });
$('undo').addEventListener('click', () => {
  if (!easel.marked) board.drawImage(easel.earlier.pop(), 0, 0);
  marks.clearRect(0, 0, $('marks').width, $('marks').height);
  Object.assign(easel, {marked: false, last: null});
  drawEasel();
});
$('use').addEventListener('click', () => $('canvas').toBlob(content => {
  const address = easel.address;
  easel = null;
  drawEasel();
  paint(address, content);
}, 'image/png'));
$('leave').addEventListener('click', () => { easel = null; drawEasel(); });

// ------------------------------------------------------------------------------------------------ export

function drawExport() {
  const {work, share, error, has_npm: npm, files} = state.export, made = Object.keys(files).length > 1;
  $('export-lead').textContent = 'Files for other tools, in the coordinates of the capture.';
  $('make').disabled = Boolean(work) || isBusy();
  $('sog').disabled = !npm;
  $('sog-words').textContent = npm ? 'also .sog and .html, for the web: takes minutes, and the first time downloads 210 MB' : 'also .sog and .html: needs Node with npm, which is not installed here';
  $('made').hidden = !work;
  if (share != null) $('made').value = share; else $('made').removeAttribute('value');
  $('make').textContent = made ? 'Make all formats again' : 'Make all formats';
  $('making').textContent = work ? `Making ${work}${share != null ? `, ${Math.round(100 * share)} %` : ' …'}` : error;
  $('making').classList.toggle('wrong', Boolean(error) && !work);
  if (!changed('exports', files)) return;
  $('exports').replaceChildren(...Object.entries(files).map(([name, {words, bytes}]) => {
    const item = make('li');
    item.append(make('a', name, {className: 'button', href: at(`export/${encodeURIComponent(name)}`), download: ''}), make('span', words),
      make('span', bytes > 1e6 ? `${(bytes / 1e6).toFixed(1)} MB` : `${Math.ceil(bytes / 1e3)} kB`, {className: 'quiet'}));
    return item;
  }));
}

$('make').addEventListener('click', () => { $('make').disabled = true; act('export', 'making', {sog: $('sog').checked}); });

// The cookie has the token by now, and the address bar should not show it.
if (location.search) history.replaceState(null, '', location.pathname + location.hash);
addEventListener('hashchange', route);
route();
