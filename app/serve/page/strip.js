// The strip of views: thumbnails that load when they come into sight, clicks and entropy.
import {photoAddress} from './api.js';
import {byId, make, setAttribute, setStyle, setText} from './dom.js';
import {orderedViews} from './model.js';

export class Strip {
  constructor(open) {
    this.open = open;
    this.list = byId('strip');
    this.order = byId('order');
    this.items = [];
    this.shown = [];
    this.seen = new IntersectionObserver((entries) => {
      for (const {isIntersecting, target} of entries) {
        if (!isIntersecting) continue;
        this.seen.unobserve(target);
        const image = target.querySelector('img');
        image.src = photoAddress(target.dataset.view, target.dataset.photo, 160);
        image.addEventListener('error', () => setTimeout(() => this.seen.observe(target), 3000), {once: true});
      }
    }, {root: this.list, rootMargin: '200px'});
    this.order.addEventListener('change', () => this.arrange());
    this.list.addEventListener('click', (event) => {
      const button = event.target.closest('button');
      if (button) this.open(Number(button.dataset.view));
    });
  }

  build(views) {
    this.list.replaceChildren();
    this.items = views.map((view, i) => {
      const image = make('img', {alt: '', draggable: 'false', width: view.width, height: view.height});
      const name = make('span', {class: 'name'}, make('bdi', {dir: 'ltr'}, view.frame));
      const clicks = make('span', {class: 'clicks'});
      const bar = make('span', {class: 'bar'}, make('i'));
      const badge = view.held_out ? [make('span', {class: 'badge'}, 'test')] : [];
      const button = make('button', {'data-view': i, tabindex: -1, title: view.frame}, image, name, clicks, view.held_out ? '' : bar, ...badge);
      const item = make('li', {}, button);
      return {item, button, clicks, fill: bar.firstChild};
    });
    this.arrangement = '';
  }

  /// clicks: of each view, those included that are not saved yet.
  update(views, clicks, current, proposed) {
    this.views = views.map((view, i) => ({...view, clicks: clicks[i]}));
    if (this.items.length !== views.length) this.build(views);
    setText(byId('views-title'), `${views.length} view${views.length === 1 ? '' : 's'}`);
    views.forEach((view, i) => {
      const {button, clicks: count, fill} = this.items[i];
      if (button.dataset.photo !== view.photo) {
        button.dataset.photo = view.photo;
        this.seen.unobserve(button);
        this.seen.observe(button);
      }
      const percent = Math.round(100 * view.entropy);
      setText(count, clicks[i] ? String(clicks[i]) : '');
      setStyle(fill, 'width', `${percent}%`);
      const label = view.held_out ? `${view.frame}: held out for tests, only to look at` : `${view.frame}: ${clicks[i]} click${clicks[i] === 1 ? '' : 's'}, entropy ${percent} %${i === proposed ? ', click proposed' : ''}`;
      setAttribute(button, 'aria-label', label);
      setAttribute(button, 'title', label);
      setAttribute(button, 'aria-current', i === current);
      setAttribute(button, 'tabindex', i === current ? 0 : -1);
      button.classList.toggle('proposed', i === proposed);
    });
    if (this.current !== current || !this.arrangement) {
      this.current = current;
      this.arrange();
    }
  }

  /// Sorted anew when the person asks or goes to another view, not under the pointer.
  arrange() {
    this.shown = orderedViews(this.views, this.order.value);
    const arrangement = this.shown.join();
    if (arrangement !== this.arrangement) {
      const had = this.list.contains(document.activeElement) ? document.activeElement : null;
      this.list.append(...this.shown.map((i) => this.items[i].item));
      this.arrangement = arrangement;
      had?.focus();
    }
    this.items[this.current]?.item.scrollIntoView({block: 'nearest', inline: 'nearest'});
  }

  /// The view `steps` further along the strip than `view`.
  neighbour(view, steps) {
    const at = this.shown.indexOf(view);
    return this.shown[Math.min(Math.max(at + steps, 0), this.shown.length - 1)];
  }
}
