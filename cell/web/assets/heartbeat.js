(() => {
  const words = WORDS, key = 'cell-given';
  const now = () => performance.now();
  let asked = -1e9, answered = true, seen = 0, beat = 0, count = 0, lost = false;
  let since = '';
  document.body.classList.add('unheard');  // what is pressed before the server listens is lost
  let given = [], gone = JSON.parse(sessionStorage.getItem(key) || '[]');
  const keep = () => sessionStorage.setItem(key, JSON.stringify([...gone, ...given]));
  const clock = (t) => new Date(t).toLocaleTimeString(document.documentElement.lang,
                                                      {hourCycle: 'h23'});
  const text = (id, said) => {
    const place = document.getElementById(id);
    if (place && place.textContent !== said) place.textContent = said;
  };
  const show = () => {
    const old = now() - seen > LOST, opening = !beat && now() < OPENING;
    if (old && !lost) since = clock(Date.now() - (now() - seen));
    lost = old;
    if (lost) {
      text('no-connection-word', opening ? words.opening : words.none);
      text('no-connection-since', opening ? '' : `${words.since} ${since}`);
    }
    document.body.classList.toggle('no-connection', lost);
    document.body.classList.toggle('opening', lost && opening);
    for (const button of document.querySelectorAll('main button, .q-dialog button')) {
      if (lost && !button.disabled) {
        button.disabled = true;
        button.dataset.lost = '1';
      } else if (!lost && button.dataset.lost) {
        button.disabled = button.classList.contains('disabled');
        delete button.dataset.lost;
      }
    }
    const open = [...gone, ...given.filter((g) => now() - g.since > LOST)];
    text('no-answer', open.map((g) => `${g.what}, ${clock(g.at)}: ${words.lost}`).join(' '));
    document.body.classList.toggle('no-answer', open.length > 0);
  };
  const look = () => {
    if (window.socket?.connected && window.did_handshake && (answered || now() - asked > AGAIN)) {
      asked = now();
      answered = false;
      emitEvent('heartbeat', asked);
    }
    show();
  };
  window.cell = {
    heard(question, number) {
      answered ||= question === asked;
      if (question > seen) [seen, beat] = [question, number];
      document.body.classList.remove('unheard');
      show();
    },
    give(emit, what) {
      if (lost || !beat) return;
      gone = [];
      given.push({what, number: ++count, at: Date.now(), since: now()});
      keep();
      emit(beat, count);
    },
    done(number) {
      given = given.filter((g) => g.number !== number);
      keep();
      show();
    },
  };
  setInterval(look, EVERY);
  document.addEventListener('visibilitychange', look);
  document.addEventListener('DOMContentLoaded', show);
})();
