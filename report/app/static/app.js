'use strict';
const $ = id => document.getElementById(id);
const STEPS = {photographs: 'Photographs', object: 'Object', start: 'Start', live: 'Live 3D', result: 'Result', paint: 'Paint', export: 'Export'};
let scene = '', step = 'photographs', state = null, source = null, shownView = '', shown = {};

// What a stage does, for people who do not know the method.
const MEANING = {
  poses: 'finds where the photographs were taken', raw_masks: 'reads the masks', fit: 'builds the scene in 3D, with the object',
  masks: 'finds all of the object in 3D, and what is known behind it', reference: 'completes one picture of the hole',
  lift: 'completes every picture (for comparisons only)', initialize: 'removes the object and fills the hole in 3D',
  personalize: 'adapts the image model to the scene', distill: 'refines the filling',
  finish: 'writes the finished scene', evaluate: 'renders and scores the result',
};
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
  if (seconds < 90) return `${Math.max(1, Math.round(seconds))} s`;
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
    $('mask').hidden = $('viewer').hidden = true;
    $('mask').removeAttribute('src');
    $('viewer').removeAttribute('src');
    if (source) source.close();
    source = null;
    if (scene) follow();
  }
  if (!scene) { step = 'photographs'; showRecent(); }
  draw();
}

function follow() {
  source = new EventSource(at('events'));
  source.onmessage = event => { state = JSON.parse(event.data); $('lost').hidden = true; draw(); };
  source.onerror = async () => {
    const own = source;
    try {
      await ask(at('state'));
    } catch (error) {
      if (source !== own) return;
      if (error.status === 404) { source.close(); source = null; reopen(); } else $('lost').hidden = false;
    }
  };
}

// The server was started again and knows no open scenes.
async function reopen() {
  const known = (await ask('scenes')).scenes.find(each => each.name === scene);
  try {
    await ask('scenes', {path: state ? state.source : known ? known.path : scene});
    shown = {};
    $('mask').removeAttribute('src');
    follow();
  } catch { go('photographs', ''); }
}

function drawSteps() {
  const done = state ? {
    photographs: state.pictures.length > 0, object: state.masks > 0 || state.brings_masks, start: Boolean(state.result) && !state.plan.due.length,
    result: Boolean(state.result), live: false, paint: state.to_paint.some(each => each.painted), export: Object.keys(state.export.files).length > 1,
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
  const {stage, share, left} = state.job;
  $('pill').href = `#${encodeURIComponent(scene)}/start`;
  $('pill').textContent = `${stage || 'planning'}${share != null ? ` ${Math.round(100 * share)} %` : ''}${left ? `, ${duration(left)} left` : ''}`;
}

// ------------------------------------------------------------------------------------------------ photographs

async function showRecent() {
  const {scenes, first} = await ask('scenes');
  if (first && !sessionStorage.begun) { sessionStorage.begun = 1; go('photographs', first); return; }
  const words = {finished: 'finished', begun: 'begun', new: 'not begun'};
  $('recent').replaceChildren(...(scenes.length ? [make('h3', 'Recent scenes')] : []), ...scenes.map(each => {
    const button = make('button', make('span', each.name));
    button.append(make('small', words[each.state]));
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
  const doubts = [...state.doubts, ...(plan.error && !plan.busy ? [plan.error] : [])];
  $('doubts').hidden = !doubts.length;
  if (changed('doubts', doubts)) {
    $('doubts').firstChild.textContent = `${doubts.length} doubt${doubts.length === 1 ? '' : 's'}`;
    $('doubts').lastChild.replaceChildren(...doubts.map(words => make('li', words)));
    $('doubts').open = doubts.length > 0 && doubts.length < 4;
  }
  $('checking').textContent = plan.busy ? 'looking at the capture …' : '';
  $('next').hidden = !pictures.length;
  $('next').textContent = masks ? 'Next: start the job' : 'Next: mark the object';
  $('next').href = `#${encodeURIComponent(scene)}/${masks ? 'start' : 'object'}`;
  $('next').onclick = masks ? null : wantMasks;
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
  if (open) {
    $('object-progress').replaceChildren();
    $('object-buttons').replaceChildren();
    return;
  }
  if ((masks || state.brings_masks) && !ask_) {
    $('object-lead').textContent = `${masks ? `${masks} views have a mask` : 'The scene brings masks'}. Go on, or change them by clicks.`;
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
  if (ready || !isBusy()) {
    if (Date.now() - asked > 3000) wantMasks();
  }
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

function drawStart() {
  const {job, plan} = state, due = plan.due.length, running = job.state === 'running';
  $('run').hidden = isBusy();
  $('run').disabled = plan.busy || Boolean(plan.error) || state.lacks_masks || !due;
  $('run').textContent = job.state === 'stopped' || job.state === 'failed' ? 'Go on' : 'Start';
  $('halt').hidden = !running;
  $('bar').hidden = !isBusy();
  if (job.left != null && plan.seconds) $('bar').value = Math.max(0, 1 - job.left / plan.seconds); else $('bar').removeAttribute('value');
  let lead = '';
  if (job.state === 'elsewhere') lead = `${job.words}.`;
  else if (running && job.target !== 'all') lead = `Prepares the step Object, up to the stage ${job.target}: ${job.stage || 'planning'}.`;
  else if (running) lead = job.stage ? `Runs the stage ${job.stage}, which ${MEANING[job.stage] || 'is needed'}.` : 'Plans the next stage.';
  else if (job.state === 'failed') lead = `The job failed: ${job.words}`;
  else if (plan.busy) lead = 'Looking at what has to run …';
  else if (state.lacks_masks) lead = 'The object is not marked yet: go to the step Object.';
  else if (plan.error) lead = plan.error;
  else if (!due && state.result) lead = 'Everything is done. Look at the result, or paint a view.';
  else if (job.state === 'stopped') lead = job.words;
  else lead = state.result ? 'Something changed: only the stages that depend on it run again.' : 'Fits the scene, removes the object, and fills the hole. You may close this page meanwhile.';
  $('start-lead').textContent = lead;
  $('start-lead').classList.toggle('wrong', job.state === 'failed' || (Boolean(plan.error) && !plan.busy && !isBusy()));
  $('total').textContent = isBusy() ? (job.left ? `about ${duration(job.left)} left` : '') :
    due && !plan.busy && !plan.error && plan.seconds ? `about ${duration(plan.seconds)} in all` : '';
  if (changed('stages', [plan.stages, job.stage, job.done])) {
    $('stages').tBodies[0].replaceChildren(...plan.stages.map(each => {
      const done = ['cached', 'provided'].includes(each.word) || job.done.includes(each.name);
      const kind = each.name === job.stage ? 'running' : done ? 'done' : each.word === 'skip' ? 'skip' : each.word === 'missing' ? 'missing' : '';
      const row = make('tr', '', {className: kind});
      const what = make('td', MEANING[each.name] || '');
      if (!done && !/^(not run yet|waits for|left out if)/.test(each.reason)) what.append(make('small', each.reason));
      row.append(make('td', each.name), what, make('td', done || kind === 'skip' ? '' : duration(each.seconds)));
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

const act = (name, id = 'start-lead') => ask(at(`do/${name}`), {}).catch(error => { $(id).textContent = error.message; });
$('run').addEventListener('click', () => {
  if (state.has_unsaved_marks && !confirm('Your last marks are not in the saved masks. Start without them? (To use them, save the masks in the step Object.)')) return;
  $('run').disabled = true;
  act('start');
});
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
  if (!state.has_state) { $('live-lead').textContent = 'Comes with the stage fit.'; return; }
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
  if (!result) { $('verdict').textContent = 'The result comes at the end of the job.'; return; }
  $('verdict').textContent = result.verdict || 'The scene is finished.';
  $('correct').href = `#${encodeURIComponent(scene)}/object`;
  $('complete').href = `#${encodeURIComponent(scene)}/paint`;
  if (changed('views', result.views)) $('view').replaceChildren(...result.views.map(name => make('option', name)));
  if (!result.views.includes(shownView)) choose(result.views.find(name => result.rendered.includes(name)) || result.views[0]);
  else if (changed('compared', [shownView, state.version])) choose(shownView);
}

function choose(name) {
  shownView = name;
  changed('compared', [shownView, state.version]);
  $('view').value = name;
  $('before').src = picture('photo', name);
  $('after').src = picture('result', name);
  $('overlay').src = picture('unsure', name);
}

function move(by) {
  const {views} = state.result;
  choose(views[(views.indexOf(shownView) + by + views.length) % views.length]);
}

$('before').addEventListener('load', () => $('slider').style.setProperty('--ratio', $('before').naturalWidth / $('before').naturalHeight));
$('view').addEventListener('change', () => choose($('view').value));
$('previous').addEventListener('click', () => move(-1));
$('following').addEventListener('click', () => move(1));
$('slider').querySelector('input').addEventListener('input', event => $('slider').style.setProperty('--at', `${event.target.value / 10}%`));
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
    'Grey is what no photograph shows. Paint a view here; or download it, complete the grey part with any program, keep the framing, and upload it. Then Start runs what depends on it.' :
    'Nothing has to be painted: the photographs show all that the object hid, or scene.yaml names a reference.';
  if (!changed('paint', [views, state.version])) return;
  $('paintings').replaceChildren(...views.map((each, k) => {
    const address = at(`paint/${encodeURIComponent(each.view)}`), figure = make('figure'), row = make('p', '', {className: 'row'});
    const file = make('input', '', {type: 'file', accept: 'image/png,image/jpeg,image/webp', hidden: true});
    const button = make('button', each.painted ? 'Upload another' : 'Upload completed');
    button.addEventListener('click', () => file.click());
    file.addEventListener('change', () => paint(address, file.files[0]));
    const words = `${each.view}: shows ${Math.round(100 * each.share)} % of the hole${k ? ' that the views before do not show' : ''}${each.painted ? '. Painted.' : ''}`;
    const here = make('button', 'Paint here', {className: 'main'});
    here.addEventListener('click', () => beginPainting(address));
    row.append(here, make('a', 'Download', {className: 'button', href: address, download: `${each.view}.png`}), button, file);
    figure.append(make('img', '', {src: `${address}?${state.version}`, alt: `${each.view}, to be painted`, loading: 'lazy'}), make('p', words), row);
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
  const {busy, error, files} = state.export, made = Object.keys(files).length > 1;
  $('export-lead').textContent = 'Files for other tools, in the coordinates of the capture.';
  $('make').disabled = Boolean(busy) || isBusy();
  $('make').textContent = made ? 'Make all formats again' : 'Make all formats';
  $('making').textContent = busy ? `making: ${busy} …` : error;
  $('making').classList.toggle('wrong', Boolean(error) && !busy);
  if (!changed('exports', files)) return;
  $('exports').replaceChildren(...Object.entries(files).map(([name, {words, bytes}]) => {
    const item = make('li');
    item.append(make('a', name, {className: 'button', href: at(`export/${encodeURIComponent(name)}`), download: ''}), make('span', words),
      make('span', bytes > 1e6 ? `${(bytes / 1e6).toFixed(1)} MB` : `${Math.ceil(bytes / 1e3)} kB`, {className: 'quiet'}));
    return item;
  }));
}

$('make').addEventListener('click', () => { $('make').disabled = true; act('export', 'making'); });

addEventListener('hashchange', route);
route();
