// What the slider and the button of a cycle's film do, in the browser alone.
window.film = {
  times: [], base: '', at: 0, timer: null,
  show(k) {
    this.at = Math.max(0, Math.min(this.times.length - 1, k));
    document.getElementById('film-frame').src = `${this.base}/${this.at}.jpg`;
    document.getElementById('film-slider').value = this.at;
    document.getElementById('film-time').textContent =
      `${this.times[this.at].toFixed(3)} s · ${this.at + 1}/${this.times.length}`;
  },
  stop() { clearInterval(this.timer); this.timer = null; },
  play() {
    if (this.timer) { this.stop(); return; }
    if (this.at >= this.times.length - 1) this.show(0);
    const from = this.times[this.at], begun = performance.now();
    this.timer = setInterval(() => {
      if (!document.getElementById('film-frame').complete) return;
      const t = from + (performance.now() - begun) / 1000 / SLOWER;
      let k = this.at;
      while (k < this.times.length - 1 && this.times[k + 1] <= t) k++;
      if (k !== this.at) this.show(k);
      if (k >= this.times.length - 1) this.stop();
    }, 60);
  },
};
