// The panel: sliders, choices, a table of figures, and keyboard actions.

class Panel {
  constructor(root, title, note, signal) {
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
      const view = event.shiftKey && event.key.startsWith('Arrow');  // they turn the camera
      if (view || event.ctrlKey || event.metaKey || event.altKey) return;
      const key = event.key === '=' ? '+' : event.key.toLowerCase(), {target} = event;
      // Buttons use the space bar themselves, and sliders the arrow keys.
      if (target.matches?.('button, summary') && key === ' ') return;
      if (target.matches?.('input') && key.startsWith('arrow') && this.owners.get(key) !== target) return;
      const action = this.keys.get(key);
      if (!action) return;
      event.preventDefault();
      action();
    }, {signal});
    this.fold = () => fold.onclick();
  }

  #add(parent, kind) { return parent.appendChild(document.createElement(kind)); }

  // Adds a line of the help: an action with mouse, touch or key, and its effect.
  explain(how, what) {
    const row = this.#add(this.help, 'tr');
    this.#add(row, 'td').textContent = how;
    this.#add(row, 'td').textContent = what;
  }

  // Adds a key, by the browser's name in lower case, with its line of the help.
  key(key, how, what, action) {
    this.keys.set(key, action);
    if (how) this.explain(how, what);
  }

  // Adds a slider; returns a function that sets it and calls `changed`. `keys` move it by `by` or to the result of `next`.
  // With `tint` there is a colour beside it, which this gets as three numbers from 0 to 1.
  slider(name, {min, max, step, value, text, changed, keys = [], by = step, next = (now, sign) => now + sign * by, told, tint}) {
    const label = this.#add(this.controls, 'label');
    this.#add(label, 'span').textContent = name;
    const input = Object.assign(this.#add(label, 'input'), {type: 'range', min, max, step, value});
    input.setAttribute('aria-label', name);
    if (tint) {
      label.className = 'tinted';
      const colour = Object.assign(this.#add(label, 'input'), {type: 'color', value: '#ffffff'});
      colour.setAttribute('aria-label', `colour of ${name}`);
      colour.oninput = () => tint([1, 3, 5].map((at) => parseInt(colour.value.slice(at, at + 2), 16) / 255));
    }
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

  // Adds a group of buttons, one of them pressed; returns a function that presses one.
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

  // Adds a toggle button with a key.
  toggle(name, key, value, changed) {
    const button = this.#button(this.#row(''), name, () => {
      value = !value;
      button.setAttribute('aria-pressed', value);
      changed(value);
    });
    button.setAttribute('aria-pressed', value);
    this.key(key, key.toUpperCase(), name, button.onclick);
  }

  // Adds the button that plays and pauses; `changed` gets the state.
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
      // After a click the button loses the focus, so that the space bar plays; keyboard users keep the focus.
      if (event?.detail) button.blur();
      action();
    };
    return button;
  }

  // Describes the point under the pointer, in parts; undefined parts are skipped.
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
