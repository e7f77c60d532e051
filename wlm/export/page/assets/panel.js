// The panel: sliders, choices and a table of figures, and what the keyboard does.

class Panel {
  constructor(root, title, note) {
    this.root = root;
    this.rows = new Map();
    this.keys = new Map();    // by key: what it does
    this.owners = new Map();  // by key: the slider that it moves
    const header = this.#add(root, 'header');
    this.#add(header, 'h1').textContent = title;
    const fold = this.#add(header, 'button');
    const name = () => {
      const folded = root.classList.contains('folded');
      fold.textContent = folded ? '+' : '–';
      fold.title = folded ? 'unfold the panel (H)' : 'fold the panel (H)';
      fold.setAttribute('aria-label', fold.title);
      fold.setAttribute('aria-expanded', !folded);
    };
    fold.onclick = () => { root.classList.toggle('folded'); name(); window.dispatchEvent(new Event('resize')); };
    name();
    if (note) this.#add(root, 'p').textContent = note;
    this.told = this.#add(root, 'p');
    this.told.className = 'told';
    this.controls = this.#add(root, 'div');
    this.figures = this.#add(root, 'table');
    const help = this.#add(root, 'details');
    this.#add(help, 'summary').textContent = 'mouse, touch and keys';
    this.help = this.#add(help, 'table');
    window.addEventListener('keydown', (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      const key = event.key === '=' ? '+' : event.key.toLowerCase(), {target} = event;
      // Buttons have the space bar, and sliders the arrows, for themselves.
      if (target.matches?.('button, summary') && key === ' ') return;
      if (target.matches?.('input') && key.startsWith('arrow') && this.owners.get(key) !== target) return;
      const action = this.keys.get(key);
      if (!action) return;
      event.preventDefault();
      action();
    });
    this.fold = () => fold.onclick();
  }

  #add(parent, kind) { return parent.appendChild(document.createElement(kind)); }

  // A line of the help: what one does with the mouse, a finger or a key, and what for.
  explain(how, what) {
    const row = this.#add(this.help, 'tr');
    this.#add(row, 'td').textContent = how;
    this.#add(row, 'td').textContent = what;
  }

  // A key, by the browser's name of it in small letters, with its line of the help.
  key(key, how, what, action) {
    this.keys.set(key, action);
    if (how) this.explain(how, what);
  }

  // A slider; gives a function that sets it and tells `changed`. `keys` move it, by `by` or to what `next` says.
  slider(name, {min, max, step, value, text, changed, keys = [], by = step, next = (now, sign) => now + sign * by, told}) {
    const label = this.#add(this.controls, 'label');
    this.#add(label, 'span').textContent = name;
    const input = Object.assign(this.#add(label, 'input'), {type: 'range', min, max, step, value});
    input.setAttribute('aria-label', name);
    const output = this.#add(label, 'output');
    const show = () => {
      output.textContent = text(Number(input.value));
      input.setAttribute('aria-valuetext', output.textContent);
    };
    const set = (wanted) => {
      input.value = wanted;
      show();
      changed(Number(input.value));
    };
    input.oninput = () => set(input.value);
    show();
    keys.forEach((key, i) => {
      this.owners.set(key, input);
      this.keys.set(key, () => set(next(Number(input.value), 2 * i - 1)));
    });
    const names = {arrowleft: '←', arrowright: '→'};
    if (keys.length) this.explain(keys.map((key) => names[key] ?? key).join(' '), told ?? name);
    return set;
  }

  // Named buttons of which one is pressed; gives a function that presses one.
  choices(title, names, value, changed, firstKey) {
    const row = this.#row(title), buttons = new Map();
    const press = (name) => {
      for (const [each, button] of buttons) button.setAttribute('aria-pressed', each === name);
      changed(name);
    };
    names.forEach((name, i) => {
      const button = this.#button(row, name, () => press(name));
      buttons.set(name, button);
      button.setAttribute('aria-pressed', name === value);
      if (firstKey) this.keys.set(String(firstKey + i), button.onclick);
    });
    if (firstKey) this.explain(`${firstKey} to ${firstKey + names.length - 1}`, names.join(', '));
    return press;
  }

  // A button that is pressed or not, with a key.
  toggle(name, key, value, changed) {
    const button = this.#button(this.#row(''), name, () => {
      value = !value;
      button.setAttribute('aria-pressed', value);
      changed(value);
    });
    button.setAttribute('aria-pressed', value);
    this.key(key, key.toUpperCase(), name, button.onclick);
  }

  // The button that plays and pauses; `changed` is told which.
  player(changed) {
    let playing = false;
    const button = this.#button(this.#row(''), 'play', () => {
      playing = !playing;
      button.textContent = playing ? 'pause' : 'play';
      changed(playing);
    });
    this.key(' ', 'space', 'play, pause', button.onclick);
  }

  #row(title) {
    const row = this.#add(this.controls, 'div');
    row.className = 'choices';
    if (title) {
      row.setAttribute('role', 'group');
      row.setAttribute('aria-label', title);
      this.#add(row, 'span').textContent = title;
    }
    return row;
  }

  #button(row, name, action) {
    const button = this.#add(row, 'button');
    button.textContent = name;
    button.onclick = (event) => {
      // After the mouse the space bar plays again; who came by the keyboard stays on the button.
      if (event?.detail) button.blur();
      action();
    };
    return button;
  }

  // Says what lies under the pointer, in pieces; what is undefined is left out.
  tell(pieces) {
    const texts = pieces.filter(Boolean);
    this.told.replaceChildren(...(texts.length ? texts : ['point at the picture to read a texel']).map((text) => {
      const span = document.createElement('span');
      span.textContent = text;
      return span;
    }));
  }

  // Sets one row of the table.
  figure(name, text) {
    if (!this.rows.has(name)) {
      const row = this.#add(this.figures, 'tr');
      this.#add(row, 'td').textContent = name;
      this.rows.set(name, this.#add(row, 'td'));
    }
    this.rows.get(name).textContent = text;
  }
}
