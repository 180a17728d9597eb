#include "app/serve/page_state.h"

#include <optional>

#include "app/serve/page_pictures.h"

namespace semfield::app {

namespace {

Json run_json(const LabelState& s, const std::string& id) {
  return {{"id", id},
          {"name", s.name},
          {"folder", s.run_dir},
          {"device", s.device},
          {"step", s.step},
          {"train_s", s.train_s},
          {"loss", s.loss},
          {"psnr", s.psnr_db},
          {"rays_per_s", s.rays_per_s},
          {"phase", s.phase},
          {"geometry_ready", s.geometry_ready},
          {"temperature", s.temperature}};
}

Json class_json(const ClassState& c) {
  return {{"index", c.index},
          {"id", c.id},
          {"name", c.name},
          {"own", c.own},
          {"color", c.color},
          {"clicks", c.clicks},
          {"area_share", c.area_share},
          {"confidence", c.confidence}};
}

Json view_json(const ViewState& v) {
  return {{"frame", v.frame},     {"width", v.width_px}, {"height", v.height_px}, {"clicks", v.clicks},
          {"entropy", v.entropy}, {"ready", v.ready},    {"photo", v.photo},      {"held_out", v.held_out}};
}

Json mark_json(const Annotations::Mark& mark, const LabelSource& source) {
  return {{"id", mark.id},
          {"view", source.view_of(mark.frame)},
          {"points", points_json(mark.points)},
          {"radius", mark.radius_px},
          {"fill", mark.fill},
          {"object", mark.object},
          {"class", mark.class_index}};
}

Json proposal_json(const std::optional<ProposalState>& p) {
  if (!p) return nullptr;
  return {
      {"id", p->id}, {"view", p->view}, {"at", {p->at.x, p->at.y}}, {"why", p->why}, {"class_guess", p->class_guess}};
}

}  // namespace

Json state_json(const LabelState& s, const LabelSource& source, const std::vector<ExportState>& exports,
                const std::string& run_id, std::uint64_t known, std::uint64_t first, std::uint64_t now) {
  Json out;
  out["revision"] = now;
  out["overlay"] = {{"revision", first + s.overlay_revision}, {"events", s.overlay_events}};
  out["events"] = s.events;
  out["run"] = run_json(s, run_id);
  out["room"] = {{"named", s.named}, {"most", s.room}};
  out["classes"] = json_list(s.classes, class_json);
  out["views"] = json_list(s.views, view_json);
  out["proposal"] = proposal_json(s.proposal);
  out["marks"] = nullptr;
  if (known == 0 || s.marks_revision > known)
    out["marks"] = json_list(s.marks, [&](const Annotations::Mark& mark) { return mark_json(mark, source); });
  out["exports"] = json_list(exports, [](const ExportState& e) {
    return Json{{"id", e.id}, {"what", e.what}, {"state", e.state}, {"text", e.text}, {"files", e.files}};
  });
  out["notes"] = s.notes;
  out["trouble"] = s.trouble;
  out["failure"] = s.failure;
  return out;
}

}  // namespace semfield::app
