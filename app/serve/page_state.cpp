#include "app/serve/page_state.h"

#include <filesystem>
#include <nlohmann/json.hpp>
#include <optional>

#include "app/serve/page_server.h"
#include "core/error.h"
#include "system/files.h"

namespace semfield::app {

namespace {

using Json = nlohmann::ordered_json;

// Texts of files and folders may be no UTF-8; numbers that are none become null.
std::string text_of(const Json& json) { return json.dump(-1, ' ', false, Json::error_handler_t::replace); }

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

Json mark_json(const Annotations::Mark& mark, const PageSource& source) {
  Json points = Json::array();
  for (const PixelPoint& p : mark.points) points.push_back({p.x, p.y});
  return {{"id", mark.id},
          {"view", source.view_of(mark.frame)},
          {"points", std::move(points)},
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

template <class Items, class ToJson>
Json list(const Items& items, ToJson&& to_json) {
  Json out = Json::array();
  for (const auto& item : items) out.push_back(to_json(item));
  return out;
}

int status_of(ErrorKind kind) {
  if (kind == ErrorKind::data || kind == ErrorKind::usage) return 400;
  return kind == ErrorKind::internal ? 500 : 503;
}

}  // namespace

std::string state_json(const LabelState& s, const PageSource& source, const std::vector<ExportState>& exports,
                       const std::string& run_id, std::uint64_t known, const PageRevision& revision) {
  Json out;
  out["revision"] = revision.now;
  out["overlay"] = {{"revision", revision.first + s.overlay_revision}, {"events", s.overlay_events}};
  out["events"] = s.events;
  out["run"] = run_json(s, run_id);
  out["room"] = {{"named", s.named}, {"most", s.room}};
  out["classes"] = list(s.classes, class_json);
  out["views"] = list(s.views, view_json);
  out["proposal"] = proposal_json(s.proposal);
  out["marks"] = nullptr;
  if (known == 0 || s.marks_revision > known)
    out["marks"] = list(s.marks, [&](const Annotations::Mark& mark) { return mark_json(mark, source); });
  out["history"] = nullptr;
  if (known == 0 || s.history_revision > known)
    out["history"] = list(s.history, [](const HistoryRow& row) {
      return Json{row.train_s, row.loss, row.psnr_db, row.clicks};
    });
  out["exports"] = list(exports, [](const ExportState& e) {
    return Json{{"id", e.id}, {"what", e.what}, {"state", e.state}, {"text", e.text}, {"files", e.files}};
  });
  out["notes"] = s.notes;
  out["trouble"] = s.trouble;
  out["failure"] = s.failure;
  return text_of(out);
}

std::string camera_json(const FreeCamera& camera) {
  const Pose& pose = camera.world_from_camera;
  Json rotation = Json::array();
  for (const auto& row : pose.r)
    for (const double value : row) rotation.push_back(value);
  return text_of({{"position", {pose.t.x, pose.t.y, pose.t.z}}, {"rotation", rotation}, {"fov_deg", camera.fov_deg}});
}

std::string error_json(Code code, const std::string& message, const std::string& remedy) {
  return text_of({{"error", message}, {"code", code.text()}, {"remedy", remedy}});
}

HttpResponse safe_answer(const std::function<HttpResponse()>& answer) noexcept {
  try {
    try {
      return answer();
    } catch (const Error& e) {
      return {status_of(e.kind()), "application/json", error_json(e.code(), e.message(), e.remedy())};
    } catch (const std::exception& e) {
      return {500, "application/json",
              error_json("internal.exception", std::string("internal error: ") + e.what(), "")};
    }
  } catch (const std::exception&) {  // no memory
    return {500, "text/plain", ""};
  }
}

HttpResponse wrong_method(const char* allowed) {
  HttpResponse wrong{405, "application/json",
                     error_json("serve.request.method", "this address takes another method", "")};
  wrong.allow = allowed;
  return wrong;
}

namespace {

namespace fs = std::filesystem;

struct Kept {
  std::string id, place;
};

// None: there is no such file, or it holds something else.
std::optional<Kept> kept_in(const fs::path& run_dir) {
  constexpr std::size_t kMostBytes = 8192;
  std::error_code unknown;
  const fs::path file = run_dir / "run_id";
  if (!fs::is_regular_file(file, unknown)) return std::nullopt;
  const std::string text = read_file_start(file.string(), kMostBytes);
  const std::size_t end = text.find('\n');
  if (end != 32 || text.find_first_not_of("0123456789abcdef") != end || !text.ends_with('\n')) return std::nullopt;
  return Kept{text.substr(0, end), text.substr(end + 1, text.size() - end - 2)};
}

bool is_copy(const Kept& kept, const fs::path& place) {
  std::error_code unknown;
  if (kept.place == place || fs::equivalent(kept.place, place, unknown)) return false;
  const std::optional<Kept> original = kept_in(kept.place);
  return original && original->id == kept.id;
}

}  // namespace

std::string kept_run_id(const std::string& run_dir) {
  const fs::path place = fs::weakly_canonical(fs::absolute(run_dir));
  std::optional<Kept> kept = kept_in(place);
  if (kept && kept->place == place) return kept->id;
  if (kept && is_copy(*kept, place)) {
    fs::remove(place / "serve_token");
    kept.reset();
  }
  const std::string id = kept ? kept->id : new_token();
  write_file_atomic((place / "run_id").string(), id + "\n" + place.string() + "\n");
  return id;
}

}  // namespace semfield::app
