// What each key of the page does; the help in dialogs.js tells it.
import {showHelp} from './dialogs.js';

/// By the names of nameOfKey.
export function actionsOf(page) {
  const {stage, labeller} = page;
  const actions = {
    'n': () => page.make(), 'F2': () => page.change(page.classOf(labeller.chosen)),
    'z': () => labeller.undo(), 'ctrl+z': () => labeller.undo(),
    'shift+z': () => labeller.redo(), 'ctrl+shift+z': () => labeller.redo(), 'ctrl+y': () => labeller.redo(),
    ' ': () => page.space(), 'g': () => page.takeGuess(), 's': () => page.skip(),
    'e': () => page.setKind(stage.kind === 'labels' ? 'entropy' : 'labels'),
    'r': () => page.setRendered(!page.isRendered),
    'o': () => { stage.isHidden = !stage.isHidden; page.changed(); },
    't': () => { page.settings.set({names: !page.settings.names}); page.changed(); },
    'c': () => { const name = stage.aim && stage.classAt(stage.aim); if (name) page.choose(name); },
    ',': () => page.neighbourClass(-1), '.': () => page.neighbourClass(1),
    '[': () => page.setRadius(page.settings.radius - 1), ']': () => page.setRadius(page.settings.radius + 1),
    '+': () => stage.zoom(1.25), '=': () => stage.zoom(1.25), '-': () => stage.zoom(0.8), '0': () => stage.fit(),
    'f': () => page.fly(), 'Escape': () => page.land(), '?': showHelp,
    'Home': () => page.show(page.strip.shown[0]), 'End': () => page.show(page.strip.shown.at(-1)),
    'Enter': () => { if (stage.cross) page.click([stage.cross]); },
  };
  for (const [key, step] of [['ArrowLeft', -1], ['ArrowUp', -1], ['ArrowRight', 1], ['ArrowDown', 1]]) {
    actions[key] = () => page.show(page.strip.neighbour(page.index, step));
    const [dx, dy] = key === 'ArrowLeft' || key === 'ArrowRight' ? [step, 0] : [0, step];
    actions[`shift+${key}`] = () => stage.moveCross(dx, dy, false);
    actions[`ctrl+shift+${key}`] = () => stage.moveCross(dx, dy, true);
  }
  for (const digit of '123456789') {
    actions[digit] = () => page.choose([...page.settings.keysOf(page.classes)].find(([, key]) => key === digit)?.[0]);
    actions[`shift+${digit}`] = () => {
      if (labeller.chosen === null) return;
      page.settings.give(labeller.chosen, digit);
      page.changed();
    };
  }
  return actions;
}
