#include "labels/serve/label_state.h"

#include <algorithm>
#include <cmath>
#include <span>
#include <utility>

#include "eval/metrics.h"
#include "labels/serve/label_session.h"

namespace semfield {

void LabelRun::describe(LabelState& state) const {
  state.name = session().config.name;
  state.run_dir = run_->run_dir();
  state.device = session().pipeline->executor().description();
  state.step = training_.step();
  state.train_s = training_.train_s();
  state.loss = loss_;
  state.psnr_db = mse_ > 0 ? -10 * std::log10(mse_) : 0;
  state.rays_per_s = rays_per_s_;
  state.geometry_ready = loop_.ready() && (loop_.learned() || !unlearned_);
  state.temperature = loop_.temperature();
  state.proposal = proposal_;
  if (state.failure.empty())
    state.phase = !still_learns()   ? "trained; more clicks continue it"
                  : !loop_.ready()  ? "learning colour and geometry"
                  : loop_.learned() ? "learning with your clicks"
                                    : "ready for the first click";
  for (ClassState& cls : state.classes) {
    const auto c = static_cast<std::size_t>(cls.index);
    if (c >= summary_.area.size()) continue;
    cls.area_share = summary_.area[c];
    cls.confidence = summary_.sure[c];
  }
  for (std::size_t v = 0; v < state.views.size(); ++v) {
    state.views[v].ready = state.views[v].held_out ? loop_.ready() : !loop_.views()[v].map.empty();
    if (v < summary_.entropy.size()) state.views[v].entropy = summary_.entropy[v];
  }
}

void LabelRun::summarise() {
  const std::vector<float>& probability = loop_.pool_probability();
  const auto width = static_cast<std::size_t>(loop_.classes());
  const std::size_t points = loop_.pool().points.size();
  std::vector<double> count(static_cast<std::size_t>(session().classes()), 0), sure(count), entropy(points, 1);
  const double most = loop_.most_entropy();
  for (std::size_t i = 0; i < points && !probability.empty(); ++i) {
    const std::span<const float> row = std::span(probability).subspan(i * width, width);
    const auto best = static_cast<std::size_t>(std::max_element(row.begin(), row.end()) - row.begin());
    const auto cls = static_cast<std::size_t>(session().plan.class_of_logit[best]);
    count[cls] += 1;
    sure[cls] += static_cast<double>(row[best]);
    entropy[i] = std::min(1.0, entropy_nats(row) / most);
  }
  summary_ = {count, sure, {}};
  for (std::size_t c = 0; c < count.size(); ++c) {
    summary_.sure[c] = count[c] > 0 ? sure[c] / count[c] : 0;
    summary_.area[c] = points > 0 ? count[c] / static_cast<double>(points) : 0;
  }
  for (const std::vector<std::int32_t>& seen : loop_.pool().point_of_pixel) {
    double sum = 0, pixels = 0;
    for (const std::int32_t point : seen) {
      if (point < 0) continue;
      sum += entropy[static_cast<std::size_t>(point)];
      pixels += 1;
    }
    summary_.entropy.push_back(pixels > 0 ? sum / pixels : 1);
  }
}

// Classes, marks and counts, from `annotations_`.
void LabelSession::name_classes(LabelState& next) const {
  const std::vector<ClassState> before = std::move(next.classes);
  next.classes.clear();
  const ClassTable& table = annotations_.classes();
  for (int c = 0; c < annotations_.named_classes(); ++c) {
    if (!annotations_.is_named(c)) continue;
    const ClassEntry& entry = table.valid(c);
    const auto known =
        std::find_if(before.begin(), before.end(), [&](const ClassState& old) { return old.index == c; });
    const ClassState old = known == before.end() ? ClassState{} : *known;
    next.classes.push_back(
        {c, entry.id, entry.name, entry.color, 0, old.area_share, old.confidence, c < annotations_.own_classes()});
  }
  for (ViewState& view : next.views) view.clicks = 0;
  next.marks = annotations_.marks();
  for (const Annotations::Mark& mark : next.marks) {
    const auto cls = std::find_if(next.classes.begin(), next.classes.end(),
                                  [&](const ClassState& c) { return c.index == mark.class_index; });
    if (cls != next.classes.end()) ++cls->clicks;
    if (const int view = view_of(mark.frame); view >= 0) ++next.views[static_cast<std::size_t>(view)].clicks;
  }
  next.named = static_cast<int>(next.classes.size());
  next.room = table.valid_count();
  next.marks_revision = next.revision + 1;
}

}  // namespace semfield
