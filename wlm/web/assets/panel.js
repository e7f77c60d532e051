// The panel: sliders, choices and a table of figures, and what the keyboard does.

class Panel {
  constructor(root, title, note) {
    this.root = root;
    this.rows = new Map();
    const header = this.#add(root, 'header');
    this.#add(header, 'h1').textContent = title;
    const fold = this.#add(header, 'button');
    fold.textContent = '–';
    fold.title = 'fold the panel (H)';
    fold.onclick = () => { root.classList.toggle('folded'); window.dispatchEvent(new Event('resize')); };
    this.fold = fold;
    if (note) this.#add(root, 'p').textContent = note;
    this.told = this.#add(root, 'p');
    this.told.className = 'told';
    this.controls = this.#add(root, 'div');
    this.figures = this.#add(root, 'table');
    const help = this.#add(root, 'details');
    this.#add(help, 'summary').textContent = 'keys and fingers';
    this.help = this.#add(help, 'div');
    this.keys = new Map([['h', () => fold.click()]]);
    window.addEventListener('keydown', (event) => {
      // Sliders and buttons have keys of their own.
      if (event.ctrlKey || event.metaKey || (event.target.matches?.('button, summary') && event.key === ' ')) return;
      const action = this.keys.get(event.key.toLowerCase());
      if (!action || (event.target.matches?.('input') && event.key.startsWith('Arrow'))) return;
      event.preventDefault();
      action();
    });
  }

  #add(parent, kind) { return parent.appendChild(document.createElement(kind)); }

  // A slider; gives a function that sets it and tells `changed`.
  slider(name, {min, max, step, value, text, changed, keys = []}) {
    const label = this.#add(this.controls, 'label');
    this.#add(label, 'span').textContent = name;
    const input = Object.assign(this.#add(label, 'input'), {type: 'range', min, max, step, value});
    input.setAttribute('aria-label', name);
    const output = this.#add(label, 'output');
    const set = (next) => {
      input.value = next;
      output.textContent = text(Number(input.value));
      changed(Number(input.value));
    };
    input.oninput = () => set(input.value);
    output.textContent = text(value);
    const by = keys[2] ?? step;
    if (keys.length) {
      this.keys.set(keys[0], () => set(Number(input.value) - by));
      this.keys.set(keys[1], () => set(Number(input.value) + by));
    }
    return set;
  }

  // Buttons of which one is pressed; gives a function that presses one.
  choices(names, value, changed, firstKey) {
    const row = this.#add(this.controls, 'div'), buttons = new Map();
    row.className = 'choices';
    const press = (name) => {
      for (const [each, button] of buttons) button.setAttribute('aria-pressed', each === name);
      changed(name);
    };
    names.forEach((name, i) => {
      const button = this.#add(row, 'button');
      button.textContent = name;
      button.onclick = () => press(name);
      buttons.set(name, button);
      button.setAttribute('aria-pressed', name === value);
      if (firstKey) this.keys.set(String(firstKey + i), button.onclick);
    });
    return press;
  }

  button(name, key, action) {
    const row = this.controls.lastElementChild?.className === 'choices' ? this.controls.lastElementChild
      : Object.assign(this.#add(this.controls, 'div'), {className: 'choices'});
    const button = this.#add(row, 'button');
    button.textContent = name;
    button.onclick = () => action(button);
    if (key) this.keys.set(key, button.onclick);
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
