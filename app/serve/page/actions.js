// What each key of the page does; the help in dialogs.js describes it.
import {showHelp} from './dialogs.js';

/// By the names of nameOfKey.
export function actionsOf(page) {
  const {stage, labeller} = page;
  const actions = {
    'n': () => page.make(), 'a': () => labeller.another(), 'F2': () => page.change(page.classOf(labeller.chosen)),
    'z': () => page.undo(), 'ctrl+z': () => page.undo(),
    'shift+z': () => labeller.redo(), 'ctrl+shift+z': () => labeller.redo(), 'ctrl+y': () => labeller.redo(),
    ' ': () => page.space(), 'g': () => page.takeGuess(), 's': () => page.skip(),
    'e': () => page.setKind(stage.kind === 'labels' ? 'entropy' : 'labels'),
    'r': () => page.setRendered(!page.isRendered),
    'o': () => { stage.isHidden = !stage.isHidden; page.changed(); },
    't': () => { page.settings.set({names: !page.settings.names}); page.changed(); },
    'c': () => page.chooseSeen(),
    'b': () => stage.tools.use('brush'), 'p': () => stage.tools.use('polygon'), 'x': () => stage.tools.use('erase'),
    'i': () => page.choose(labeller.ignore.name), 'Delete': () => page.remove(),
    'Backspace': () => { if (!stage.tools.takeBack()) page.remove(); },
    ',': () => page.neighbourClass(-1), '.': () => page.neighbourClass(1),
    '[': () => page.setRadius(page.settings.radius - 1), ']': () => page.setRadius(page.settings.radius + 1),
    '+': () => stage.zoom(1.25), '=': () => stage.zoom(1.25), '-': () => stage.zoom(0.8), '0': () => stage.fit(),
    'f': () => page.fly(), 'v': () => (page.flight ? page.flights.toPhotograph() : page.messages.tell('v goes from a flight to the nearest photograph; f flies.')),
    'Escape': () => page.leave(), '?': showHelp,
    'Home': () => page.show(page.strip.shown[0]), 'End': () => page.show(page.strip.shown.at(-1)),
    'Enter': () => page.enter(),
  };
  for (const [key, step] of [['ArrowLeft', -1], ['ArrowUp', -1], ['ArrowRight', 1], ['ArrowDown', 1]]) {
    actions[key] = () => page.step(step);
    const [dx, dy] = key === 'ArrowLeft' || key === 'ArrowRight' ? [step, 0] : [0, step];
    actions[`shift+${key}`] = () => stage.moveCross(dx, dy, false);
    actions[`ctrl+shift+${key}`] = () => stage.moveCross(dx, dy, true);
  }
  for (const digit of '123456789') {
    actions[digit] = () => page.chooseByKey(digit);
    actions[`shift+${digit}`] = () => {
      if (!page.classes.some(({name}) => name === labeller.chosen)) return page.messages.tell('First choose the class for this key.');
      page.settings.give(labeller.chosen, digit);
      page.changed();
    };
  }
  return actions;
}
