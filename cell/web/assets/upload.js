(() => {
  const zone = document.querySelector('[data-test=drop]');
  if (!zone || zone.dataset.ready) return;
  zone.dataset.ready = 'yes';
  const say = text => { zone.querySelector('.drop-said').textContent = text; };
  const send = files => {
    const total = files.reduce((sum, f) => sum + f.file.size, 0);
    if (!files.length) return;
    if (total > MOST) { say(TOO_LARGE); return; }
    const form = new FormData();
    for (const {file, name} of files) form.append('files', file, name);
    const request = new XMLHttpRequest();
    request.open('POST', '/lab/upload');
    request.upload.onprogress = e => say(Math.round(100 * e.loaded / e.total) + ' %');
    request.onerror = () => say(BROKEN);
    request.onload = () => {
      let answer = {error: request.status + ' ' + request.statusText};
      try { answer = JSON.parse(request.responseText); } catch {}
      say('');
      emitEvent('lab_uploaded', answer);
    };
    request.send(form);
  };
  const walk = async (entry, into) => {
    if (entry.isFile) {
      const file = await new Promise((good, bad) => entry.file(good, bad));
      into.push({file, name: entry.fullPath.replace(/^\//, '')});
    } else {
      const reader = entry.createReader();
      for (;;) {
        const some = await new Promise((good, bad) => reader.readEntries(good, bad));
        if (!some.length) break;
        for (const one of some) await walk(one, into);
      }
    }
  };
  zone.ondragover = e => { e.preventDefault(); zone.classList.add('drop-over'); };
  zone.ondragleave = () => zone.classList.remove('drop-over');
  zone.ondrop = async e => {
    e.preventDefault();
    zone.classList.remove('drop-over');
    const entries = [...e.dataTransfer.items].map(i => i.webkitGetAsEntry()).filter(Boolean);
    const found = [];
    for (const entry of entries) await walk(entry, found);
    send(found);
  };
  for (const input of zone.querySelectorAll('input')) {
    input.onchange = () => {
      send([...input.files].map(f => ({file: f, name: f.webkitRelativePath || f.name})));
      input.value = '';
    };
  }
})();
