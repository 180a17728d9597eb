#include "app/objects/object_files.h"

#include <fmt/format.h>
#include <sys/stat.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <chrono>
#include <exception>
#include <map>
#include <thread>

#include "core/checksum.h"
#include "core/error.h"
#include "formats/image_io.h"
#include "formats/text_rows.h"
#include "surface/mesh/mesh_files.h"

namespace semfield::app {

namespace {

Json numbers(Vec3d v) { return {v.x, v.y, v.z}; }

Json row_json(const ObjectRow& row, const ClassTable& classes) {
  return {{"id", row.id},
          {"name", object_name(row, classes)},
          {"class", object_class_name(row, classes)},
          {"class_probability", row.class_probability},
          {"agreement", row.agreement},
          {"views", row.views},
          {"points", row.points},
          {"area", row.area},
          {"centroid", numbers(row.centroid)},
          {"box",
           {{"center", numbers(row.box.center)},
            {"axes", {numbers(row.box.axis[0]), numbers(row.box.axis[1]), numbers(row.box.axis[2])}},
            {"size", numbers(row.box.size)}}}};
}

std::string table_json(const EditedObjects& objects, const SceneInfo& info) {
  Json out = Json::parse(objects.set.about);
  out["unit"] = info.metric ? "m" : "scene";
  out["edits"] = objects.edits.edits.size();
  out["state"] = objects_state(objects.edits);
  Json& rows = out["objects"] = Json::array();
  for (const ObjectRow& row : objects.set.rows)
    if (row.points > 0) rows.push_back(row_json(row, info.classes));
  return json_text(out, 1) + "\n";
}

std::string table_csv(const ObjectSet& set, const ClassTable& classes) {
  std::string out =
      "id,name,class,class_probability,agreement,views,points,area,centroid_x,centroid_y,centroid_z,size_0,size_1,"
      "size_2\n";
  for (const ObjectRow& row : set.rows) {
    if (row.points == 0) continue;
    out += fmt::format("{},{},{},{:.4f},{:.4f},{},{},{:.9g},{:.9g},{:.9g},{:.9g},{:.9g},{:.9g},{:.9g}\n", row.id,
                       csv_field(object_name(row, classes)), csv_field(object_class_name(row, classes)),
                       row.class_probability, row.agreement, row.views, row.points, row.area, row.centroid.x,
                       row.centroid.y, row.centroid.z, row.box.size.x, row.box.size.y, row.box.size.z);
  }
  return out;
}

void write_points(const std::string& path, const ObjectSet& set, const ClassTable& classes) {
  PointSet points;
  std::vector<ClassEntry> names{{0, "none", {}, true}};
  for (const ObjectRow& row : set.rows) names.push_back({row.id, object_name(row, classes), {}, false});
  for (std::size_t i = 0; i < set.position.size(); ++i) {
    points.positions.push_back(set.position[i]);
    std::array<std::uint8_t, 3> color = ClassTable::default_color(set.id[i]);
    if (set.id[i] == 0)  // its own colour, paler
      for (std::size_t k = 0; k < 3; ++k)
        color[k] = static_cast<std::uint8_t>(std::min(255.0, 128 + 100.0 / 255 * set.color[i][k]));
    points.attributes.color.push_back(color);
    points.attributes.label.push_back(static_cast<std::int16_t>(set.id[i] == 0 ? kVoid : set.id[i] - 1));
    points.attributes.entropy.push_back(0);
  }
  write_ply(path, points, ClassTable(std::move(names)));
}

// The state of the tables in `folder`; "": there are none. Earlier versions told none: then that of `edits` where there
// are none that the tables could lack.
std::string tables_state(const std::string& folder, const ObjectEdits& edits) {
  const fs::path in(folder);
  for (const char* name : {"objects.json", "objects.csv", "objects.ply"})
    if (!fs::is_regular_file(in / name)) return {};
  const Json root = Json::parse(read_text_file((in / "objects.json").string()), nullptr, false);
  if (!root.is_object()) return {};
  const auto state = root.find("state");
  if (state != root.end()) return state->is_string() ? state->get<std::string>() : std::string();
  return edits.edits.empty() ? objects_state(edits) : std::string();
}

constexpr double kEditWait_s = 10;  // another edit takes a fraction of a second

// A file that was written anew has another one.
std::string stamp_of_file(const std::string& path) {
  struct stat about {};
  if (::stat(path.c_str(), &about) != 0) return "-";
  return fmt::format("{}:{}:{}.{}", about.st_ino, about.st_size, about.st_mtim.tv_sec, about.st_mtim.tv_nsec);
}

}  // namespace

std::string object_class_name(const ObjectRow& row, const ClassTable& classes) {
  return row.class_index == kVoid || row.class_index >= classes.valid_count() ? "object"
                                                                              : classes.valid(row.class_index).name;
}

std::string object_name(const ObjectRow& row, const ClassTable& classes) {
  return row.name.empty() ? fmt::format("{} {}", object_class_name(row, classes), row.id) : row.name;
}

std::string object_row_json(const ObjectRow& row, const ClassTable& classes) {
  return json_text(row_json(row, classes));
}

void check_object_count(const std::vector<ObjectRow>& rows) {
  if (std::ssize(rows) > kMostObjects)
    throw Error(ErrorKind::data, "objects.count.large",
                fmt::format("{} objects, and files hold {}", rows.size(), kMostObjects), "raise objects.least_points");
}

std::string objects_state(const ObjectEdits& edits) {
  return fmt::format("{:016x}", fnv1a64(object_edits_text(edits)));
}

void write_object_tables(const std::string& folder, const EditedObjects& objects, const SceneInfo& info) {
  check_object_count(objects.set.rows);
  const fs::path in(folder);
  write_file_atomic((in / "objects.json").string(), table_json(objects, info));
  write_file_atomic((in / "objects.csv").string(), table_csv(objects.set, info.classes));
  write_points((in / "objects.ply").string(), objects.set, info.classes);
}

std::optional<ObjectSet> objects_of_run(const std::string& run_dir, int classes) {
  const fs::path folder = fs::path(run_dir) / "objects";
  if (!fs::exists(folder / "found.safetensors")) return std::nullopt;
  ObjectSet found = read_edited_objects(folder.string(), classes).set;
  if (found.rows.empty()) return std::nullopt;
  return found;
}

ObjectFiles::ObjectFiles(std::string folder, const FoundObjects& found, const SceneInfo& info)
    : folder_(std::move(folder)), found_(found), info_(info) {
  check_object_count(found.rows);
  create_folders(path("instance"));
  create_folders(path("panoptic"));
}

std::int32_t ObjectFiles::panoptic_id(std::int32_t object, std::int16_t label) const {
  if (object > 0) return object;
  const bool is_stuff = label != kVoid && found_.stuff[static_cast<std::size_t>(label)];
  return is_stuff ? static_cast<std::int32_t>(found_.rows.size()) + 1 + label : 0;
}

void ObjectFiles::add(const ObjectView& view) {
  const Camera& camera = view.frame.camera;
  const std::string name = output_name(view.frame.name) + ".png";
  std::vector<std::uint16_t> ids(view.id.begin(), view.id.end());
  write_png_gray16(path("instance/" + name), camera.width_px, camera.height_px, ids);
  struct Segment {
    std::int32_t area = 0, x0 = 1 << 30, y0 = 1 << 30, x1 = 0, y1 = 0;
    std::int16_t class_index = kVoid;
  };
  std::map<std::int32_t, Segment> segments;
  std::vector<std::uint8_t> rgb(3 * view.id.size());
  for (std::size_t i = 0; i < view.id.size(); ++i) {
    const std::int16_t label = view.label.empty() ? kVoid : view.label[i];
    const std::int32_t id = panoptic_id(view.id[i], label);
    for (int k = 0; k < 3; ++k) rgb[3 * i + static_cast<std::size_t>(k)] = static_cast<std::uint8_t>(id >> (8 * k));
    if (id == 0) continue;
    Segment& s = segments[id];
    const auto x = static_cast<std::int32_t>(i) % camera.width_px, y = static_cast<std::int32_t>(i) / camera.width_px;
    ++s.area;
    s.x0 = std::min(s.x0, x);
    s.y0 = std::min(s.y0, y);
    s.x1 = std::max(s.x1, x + 1);
    s.y1 = std::max(s.y1, y + 1);
    s.class_index = view.id[i] > 0 ? found_.rows[static_cast<std::size_t>(view.id[i]) - 1].class_index : label;
  }
  write_png_rgb(path("panoptic/" + name), camera.width_px, camera.height_px, rgb);
  const std::size_t number = images_.size() + 1;
  Json infos = Json::array();
  for (const auto& [id, s] : segments) {
    infos.push_back({{"id", id},
                     {"category_id", s.class_index == kVoid ? 0 : info_.classes.id_of(s.class_index)},
                     {"area", s.area},
                     {"bbox", {s.x0, s.y0, s.x1 - s.x0, s.y1 - s.y0}},
                     {"iscrowd", 0}});
  }
  images_.push_back({{"id", number}, {"file_name", name}, {"width", camera.width_px}, {"height", camera.height_px}});
  annotations_.push_back({{"image_id", number}, {"file_name", name}, {"segments_info", infos}});
}

std::string ObjectFiles::panoptic_json() const {
  Json categories = Json::array();
  for (int c = 0; c < info_.classes.valid_count(); ++c) {
    const ClassEntry& entry = info_.classes.valid(c);
    categories.push_back({{"id", entry.id},
                          {"name", entry.name},
                          {"isthing", found_.stuff[static_cast<std::size_t>(c)] ? 0 : 1},
                          {"color", entry.color}});
  }
  return json_text({{"images", images_}, {"annotations", annotations_}, {"categories", categories}}, 1) + "\n";
}

FolderLock hold_objects(const std::string& folder, double wait_s) {
  const auto end = std::chrono::steady_clock::now() + std::chrono::duration<double>(wait_s);
  FolderLock lock;
  for (;;) {
    const int cause = lock.take(folder);
    if (cause == 0) return lock;
    if (cause != EWOULDBLOCK) throw write_error("write in", folder, cause);
    if (std::chrono::steady_clock::now() >= end)
      throw Error(ErrorKind::cannot_create, "objects.folder.busy",
                  fmt::format("the folder of objects '{}' is in use by {}", folder, lock.holder()),
                  "wait until it has ended");
    std::this_thread::sleep_for(std::chrono::milliseconds(20));
  }
}

const EditedObjects* ObjectFolder::look() {
  const std::string stamp = stamp_of_file(file("found.safetensors")) + " " + stamp_of_file(file("edits.json"));
  if (stamp != stamp_) {
    read_.reset();
    stamp_.clear();
    if (!stamp.starts_with("-")) {
      EditedObjects now = read_edited_objects(folder_, info_.classes.valid_count());
      if (!now.set.rows.empty()) read_ = std::move(now);
    }
    stamp_ = stamp;  // older than what was read where another program has just written: then it is read again
  }
  return read_ ? &*read_ : nullptr;
}

const EditedObjects& ObjectFolder::edit(const std::optional<ObjectEdit>& edit, const std::string& state) {
  if (look() == nullptr)
    throw Error(ErrorKind::data, "view.objects.none", folder_ + ": no objects were found in this run",
                "find them: semfield objects");
  const FolderLock alone = hold_objects(folder_, kEditWait_s);
  if (look() == nullptr || this->state() != state)
    throw Error(ErrorKind::data, "objects.edit.stale",
                "the objects were changed meanwhile, by another page or program; nothing was saved",
                "load the page again");
  EditedObjects next;
  next.edits = read_->edits;
  if (edit) {
    next.set = read_->set;
    apply_edit(next.set, *edit);
    next.edits.edits.push_back(*edit);
  } else {
    if (next.edits.edits.empty()) throw Error(ErrorKind::data, "view.undo.none", "there is no edit to take back", "");
    next.edits.edits.pop_back();
    next.set = read_object_set(file("found.safetensors"), info_.classes.valid_count());
    apply_edits(next.set, next.edits, file("edits.json"));
  }
  write(std::move(next));
  return *read_;
}

void ObjectFolder::write(EditedObjects next) {
  const std::string text = object_edits_text(next.edits);
  AtomicFile edits(file("edits.json"));
  edits.append(std::as_bytes(std::span<const char>(text.data(), text.size())));
  try {
    write_object_tables(folder_, next, info_);
    edits.commit();  // last: what could fail has not
  } catch (const std::exception&) {
    try {
      write_object_tables(folder_, *read_, info_);
    } catch (const std::exception&) {  // of the same cause; mend() does it when the run is opened again
      stamp_.clear();
    }
    throw;
  }
  read_ = std::move(next);
  stamp_ = stamp_of_file(file("found.safetensors")) + " " + stamp_of_file(file("edits.json"));
}

void ObjectFolder::mend() {
  const auto is_whole = [&] { return look() == nullptr || tables_state(folder_, read_->edits) == state(); };
  if (is_whole()) return;
  const FolderLock alone = hold_objects(folder_, kEditWait_s);
  if (!is_whole()) write_object_tables(folder_, *read_, info_);
}

}  // namespace semfield::app
