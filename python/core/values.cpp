#include "python/core/values.h"

#include <fmt/format.h>
#include <pybind11/stl.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <string_view>
#include <utility>

#include "config/params.h"
#include "core/error.h"
#include "formats/text_rows.h"

namespace semfield::python {

namespace {

using namespace pybind11::literals;

std::string place_of(const std::string& origin, const std::string& key) {
  return key.empty() ? origin : origin + ": " + key;
}

ConfigNode node_at(const py::handle& value, const Location& where, const std::string& key) {
  const auto scalar = [&](std::string text, bool quoted) {
    return ConfigNode::make_scalar(std::move(text), quoted, where);
  };
  if (value.is_none()) return ConfigNode::make_null(where);
  if (py::isinstance<py::bool_>(value)) return scalar(value.cast<bool>() ? "true" : "false", false);
  if (py::isinstance<py::str>(value)) {
    auto text = value.cast<std::string>();
    // Plain where plain YAML would be the same text: a message then shows it as a file would write it.
    const bool quoted = text.empty() || looks_typed(text);
    return scalar(std::move(text), quoted);
  }
  if (py::hasattr(value, "keys")) {
    std::vector<ConfigNode::Entry> entries;
    for (const auto& [name, item] : py::dict(py::reinterpret_borrow<py::object>(value))) {
      if (!py::isinstance<py::str>(name))
        throw Error(ErrorKind::usage, "config.key.type",
                    place_of(where.file, key) + ": a key is not text: " + py::repr(name).cast<std::string>());
      const auto word = name.cast<std::string>();
      entries.emplace_back(word, node_at(item, where, key.empty() ? word : key + "." + word));
    }
    return ConfigNode::make_map(std::move(entries), where);
  }
  if (py::isinstance<py::list>(value) || py::isinstance<py::tuple>(value)) {
    std::vector<ConfigNode> items;
    for (const py::handle item : value) items.push_back(node_at(item, where, key + "." + std::to_string(items.size())));
    return ConfigNode::make_list(std::move(items), where);
  }
  if (py::hasattr(value, "tolist")) return node_at(value.attr("tolist")(), where, key);  // arrays, and their numbers
  if (PyIndex_Check(value.ptr()) != 0) {
    const py::object whole = py::reinterpret_steal<py::object>(PyNumber_Index(value.ptr()));
    if (!whole) throw py::error_already_set();
    return scalar(py::str(whole).cast<std::string>(), false);
  }
  if (PyFloat_Check(value.ptr()) || py::hasattr(value, "__float__"))
    return scalar(shortest_number(value.cast<double>()), false);
  if (py::hasattr(value, "__fspath__")) return scalar(py::str(value.attr("__fspath__")()).cast<std::string>(), true);
  throw Error(ErrorKind::usage, "config.value.type",
              place_of(where.file, key) + ": " + py::repr(value.get_type()).cast<std::string>() +
                  " is not a value of a configuration",
              "give text, numbers, truth values, lists, dicts or paths");
}

py::object scalar_of(const ConfigNode& node) {
  const std::string& text = node.text();
  if (node.quoted() || !looks_typed(text)) return py::str(text);
  if (text == "true" || text == "false") return py::bool_(text == "true");
  const py::module_ builtins = py::module_::import("builtins");
  for (const char* type : {"int", "float"}) {
    try {
      return builtins.attr(type)(text);
    } catch (py::error_already_set& error) {
      if (!error.matches(PyExc_ValueError)) throw;
    }
  }
  return py::str(text);
}

}  // namespace

ConfigNode node_of(const py::handle& value, const std::string& origin) { return node_at(value, {origin, 0, 0}, ""); }

py::object object_of(const ConfigNode& node) {
  switch (node.kind()) {
    case ConfigNode::Kind::null:
      return py::none();
    case ConfigNode::Kind::scalar:
      return scalar_of(node);
    case ConfigNode::Kind::list: {
      py::list out;
      for (const ConfigNode& item : node.items()) out.append(object_of(item));
      return out;
    }
    case ConfigNode::Kind::map:
      break;
  }
  py::dict out;
  for (const auto& [name, item] : node.entries()) out[py::str(name)] = object_of(item);
  return out;
}

std::vector<ConfigOverride> overrides_of(const py::dict& set) {
  std::vector<ConfigOverride> out;
  for (const auto& [key, value] : set) {
    const auto name = py::str(key).cast<std::string>();
    out.push_back({name, node_of(value, "set[\"" + name + "\"]")});
  }
  return out;
}

ConfigNode with_scene(const ConfigNode& tree, const py::dict& scene) {
  const ConfigNode given = node_of(scene, "the scene");
  ConfigNode own = ConfigNode::make_map({}, given.location());
  if (const ConfigNode* before = tree.find("scene"); before != nullptr) {
    for (const char* stays : {"labels", "load"})
      if (const ConfigNode* section = before->find(stays); section != nullptr) own = own.with(stays, *section);
  }
  return tree.with("scene", merge_config(own, given));
}

ConfigNode composed(const py::object& config, const py::dict& set) {
  const std::vector<ConfigOverride> overrides = overrides_of(set);
  if (py::isinstance<py::dict>(config)) return compose_config_tree(node_of(config, "the dict"), overrides);
  return compose_config_with(py::str(config).cast<std::string>(), overrides);
}

namespace {

using Doubles = py::array_t<double, py::array::c_style | py::array::forcecast>;

// `value` as a C-ordered array of T with this shape; throws Error(data) naming what came instead.
template <class T>
py::array_t<T, py::array::c_style | py::array::forcecast> shaped(const py::object& value,
                                                                 const std::vector<py::ssize_t>& shape,
                                                                 const std::string& place) {
  const auto text = [](const auto* sizes, std::size_t count) {
    std::string out;
    for (std::size_t i = 0; i < count; ++i) out += (i == 0 ? "" : ", ") + std::to_string(sizes[i]);
    return "[" + out + "]";
  };
  const py::array given = py::array::ensure(value);
  if (!given) {
    PyErr_Clear();
    throw Error(ErrorKind::data, "python.array.type",
                place + ": expected an array, got " + py::repr(value.get_type()).cast<std::string>());
  }
  const bool same =
      given.ndim() == static_cast<py::ssize_t>(shape.size()) && std::equal(shape.begin(), shape.end(), given.shape());
  if (!same) {
    throw Error(ErrorKind::data, "python.array.shape",
                fmt::format("{}: expected the shape {}, got {}", place, text(shape.data(), shape.size()),
                            text(given.shape(), static_cast<std::size_t>(given.ndim()))));
  }
  const char kind = given.dtype().kind();
  if (std::string_view("fiub").find(kind) == std::string_view::npos)
    throw Error(ErrorKind::data, "python.array.type",
                place + ": expected real numbers, got " + py::str(given.dtype()).cast<std::string>());
  if (std::is_integral_v<T> && kind != 'u' && kind != 'i' && kind != 'b')
    throw Error(ErrorKind::data, "python.array.type",
                place + ": expected whole numbers, got " + py::str(given.dtype()).cast<std::string>(),
                sizeof(T) == 1 ? "give uint8 values of 0 to 255" : "give class ids as integers");
  if (std::is_same_v<T, std::uint8_t> && !(kind == 'u' && given.itemsize() == 1))
    throw Error(ErrorKind::data, "python.array.type",
                place + ": expected uint8, got " + py::str(given.dtype()).cast<std::string>(),
                "give values of 0 to 255 as uint8");
  return py::array_t<T, py::array::c_style | py::array::forcecast>(given);
}

Split split_of(const std::string& name, const std::string& place) {
  if (name == "train") return Split::train;
  if (name == "test") return Split::test;
  if (name == "unused") return Split::unused;
  throw Error(ErrorKind::data, "scene.split.unknown", place + ": there is no split '" + name + "'",
              "it is train, test or unused");
}

ClassTable classes_of(const py::list& classes) {
  std::vector<ClassEntry> entries;
  for (const py::handle item : classes) {
    const auto row = py::reinterpret_borrow<py::tuple>(item);
    ClassEntry entry;
    entry.id = row[0].cast<std::int32_t>();
    entry.name = row[1].cast<std::string>();
    entry.color = ClassTable::default_color(entry.id);
    if (!row[2].is_none()) {
      const auto color = row[2].cast<py::sequence>();
      for (std::size_t i = 0; i < 3; ++i) entry.color[i] = color[i].cast<std::uint8_t>();
    }
    entry.ignore = row[3].cast<bool>();
    entries.push_back(std::move(entry));
  }
  return entries.empty() ? ClassTable() : ClassTable(std::move(entries));
}

// The id -1 is no label; any other must be a class's.
template <class Ids>
std::vector<std::int16_t> indices_in(const Ids& ids, const ClassTable& classes, std::int32_t width,
                                     const std::string& place) {
  std::vector<std::int16_t> out(static_cast<std::size_t>(ids.size()));
  for (std::size_t i = 0; i < out.size(); ++i) {
    const auto id = ids.data()[i];
    const bool fits = std::cmp_greater_equal(id, 0) && std::cmp_less_equal(id, 65535);
    const int index = std::cmp_equal(id, -1) ? kVoid : fits ? classes.index_of(static_cast<std::int32_t>(id)) : -2;
    if (index == -2) {
      const auto w = static_cast<std::size_t>(width);
      throw Error(ErrorKind::data, "labels.id.unknown",
                  fmt::format("{}: pixel x {}, y {}: {} is the id of no class", place, i % w, i / w, id),
                  "add the class, or give -1 for pixels without a label");
    }
    out[i] = static_cast<std::int16_t>(index);
  }
  return out;
}

}  // namespace

py::array pose_array(const Pose& pose) {
  std::vector<double> rows(16, 0);
  for (int r = 0; r < 3; ++r) {
    const auto row = static_cast<std::size_t>(r);
    for (std::size_t c = 0; c < 3; ++c) rows[4 * row + c] = pose.r[row][c];
    rows[4 * row + 3] = pose.t[r];
  }
  rows[15] = 1;
  return array_of(std::move(rows), {4, 4});
}

Pose pose_of(const py::object& value, const std::string& place) {
  const py::array given = py::array::ensure(value);
  const bool tall = given && given.ndim() == 2 && given.shape(0) == 4;
  PyErr_Clear();
  const auto rows = shaped<double>(value, {tall ? 4 : 3, 4}, place + ": pose");
  const std::span<const double> numbers(rows.data(), static_cast<std::size_t>(rows.size()));
  Diagnostics diagnostics;
  if (tall && !check_last_row(numbers, place, diagnostics)) diagnostics.throw_if_errors(ErrorKind::data, "");
  Pose pose = pose_from_rows(numbers);
  if (check_pose(pose, place, diagnostics) == PoseState::not_finite)
    throw Error(ErrorKind::data, "scene.pose.not_finite", place + ": the pose has numbers that are not finite");
  diagnostics.throw_if_errors(ErrorKind::data, "");
  return pose;
}

constexpr const char *kFisheye = "fisheye", *kPanorama = "equirectangular";

Camera camera_of(const py::dict& camera) {
  const auto width = camera["width"].cast<std::int64_t>(), height = camera["height"].cast<std::int64_t>();
  if (width > 0 && height > 0) check_image_limits(width, height);  // check_camera says what is wrong with others
  Camera out;
  out.width_px = static_cast<std::int32_t>(width);
  out.height_px = static_cast<std::int32_t>(height);
  out.fx = camera["fx"].cast<double>();
  out.fy = camera["fy"].cast<double>();
  out.cx = camera["cx"].cast<double>();
  out.cy = camera["cy"].cast<double>();
  const auto lens = camera["distortion"].cast<py::sequence>();
  double* const values[] = {&out.k1, &out.k2, &out.p1, &out.p2, &out.k3, &out.k4};
  for (std::size_t i = 0; i < lens.size() && i < 6; ++i) *values[i] = lens[i].cast<double>();
  const auto kind = camera.contains("lens") ? camera["lens"].cast<std::string>() : std::string();
  if (kind == kFisheye) out.lens = LensKind::fisheye;
  if (kind == kPanorama) out.lens = LensKind::equirectangular;
  return out;
}

py::dict camera_dict(const Camera& c) {
  py::dict out("width"_a = c.width_px, "height"_a = c.height_px, "fx"_a = c.fx, "fy"_a = c.fy, "cx"_a = c.cx,
               "cy"_a = c.cy, "distortion"_a = py::make_tuple(c.k1, c.k2, c.p1, c.p2, c.k3, c.k4));
  if (c.is_wide()) out["lens"] = c.lens == LensKind::fisheye ? kFisheye : kPanorama;
  return out;
}

void collect(Diagnostics& diagnostics, const std::string& place, const std::function<void()>& work) {
  try {
    work();
  } catch (const Error& error) {
    const std::string before = place + ": ";
    const bool named = error.message().starts_with(before);
    diagnostics.error(error.code(), place, error.message().substr(named ? before.size() : 0), error.remedy());
  }
}

SceneInfo scene_info_of(const py::dict& scene, Diagnostics& diagnostics) {
  SceneInfo info;
  info.name = scene["name"].cast<std::string>();
  OutputNames names;
  for (const py::handle item : scene["frames"]) {
    const auto given = py::reinterpret_borrow<py::dict>(item);
    FrameInfo frame;
    frame.name = given["name"].cast<std::string>();
    frame.source = given["source"].cast<std::string>();
    const std::string place = "frame '" + frame.name + "'";
    if (const auto wrong = names.add(frame.name))
      diagnostics.error("scene.frame.name", place, *wrong, kFrameNameRemedy);
    frame.split = split_of(given["split"].cast<std::string>(), place);
    frame.has_depth = given["has_depth"].cast<bool>();
    frame.has_labels = given["has_labels"].cast<bool>();
    for (const auto& [name, grid] : given["channels"].cast<py::dict>()) {
      const auto shape = grid.cast<std::array<std::int32_t, 3>>();
      frame.channels.push_back({py::str(name).cast<std::string>(), shape[0], shape[1], shape[2]});
    }
    collect(diagnostics, place, [&] { frame.world_from_camera = pose_of(given["pose"], place); });
    collect(diagnostics, place, [&] {
      frame.camera = camera_of(given["camera"].cast<py::dict>());
      check_camera(frame.camera, place, diagnostics);
    });
    info.frames.push_back(std::move(frame));
  }
  info.classes = classes_of(scene["classes"].cast<py::list>());
  if (!scene["bounds"].is_none()) {
    const auto corners = shaped<double>(scene["bounds"], {2, 3}, "bounds");
    for (int i = 0; i < 3; ++i) {
      info.bounds.lo[i] = corners.at(0, i);
      info.bounds.hi[i] = corners.at(1, i);
      if (!(corners.at(0, i) < corners.at(1, i)))
        diagnostics.error("config.value.order", "bounds",
                          fmt::format("axis {} goes from {} to {}", "xyz"[i], corners.at(0, i), corners.at(1, i)),
                          "give the lowest corner first");
    }
  }
  info.near_hint_m = scene["near"].cast<double>();
  info.far_hint_m = scene["far"].cast<double>();
  info.metric = scene["metric"].cast<bool>();
  return info;
}

void fill_frame(const py::dict& pixels, const SceneInfo& info, int frame, FrameBuffer& out) {
  const FrameInfo& own = info.frames[static_cast<std::size_t>(frame)];
  const py::ssize_t height = own.camera.height_px, width = own.camera.width_px;
  const std::string place = "frame '" + own.name + "'";
  const std::vector<std::string> wanted = std::move(out.wanted);
  out = {};
  out.width_px = own.camera.width_px;
  out.height_px = own.camera.height_px;
  const auto rgb = shaped<std::uint8_t>(pixels["rgb"], {height, width, 3}, place + ": rgb");
  out.rgb.assign(rgb.data(), rgb.data() + rgb.size());
  if (own.has_depth) {
    const auto depth = shaped<float>(pixels["depth_m"], {height, width}, place + ": depth_m");
    out.depth_m.assign(depth.data(), depth.data() + depth.size());
    for (float& d : out.depth_m)
      if (!std::isfinite(d) || d < 0) d = 0;
  }
  if (own.has_labels)
    out.label =
        indices_of(pixels["labels"], info.classes, own.camera.height_px, own.camera.width_px, place + ": labels");
  if (pixels.contains("mask") && !pixels["mask"].is_none()) {
    const auto used = shaped<std::uint8_t>(pixels["mask"], {height, width}, place + ": mask");
    out.used.assign(used.data(), used.data() + used.size());
  }
  for (const FrameChannelInfo& channel : own.channels) {
    if (std::find(wanted.begin(), wanted.end(), channel.name) == wanted.end()) continue;
    const auto given = pixels["channels"].cast<py::dict>();
    if (!given.contains(channel.name.c_str()))
      throw Error(ErrorKind::data, "python.array.type", place + ": " + channel.name + ": expected an array, got none",
                  "give every channel that `frames` names");
    const auto values = shaped<float>(given[channel.name.c_str()], {channel.height, channel.width, channel.cols},
                                      place + ": " + channel.name);
    out.channels.push_back(
        {channel.name, channel.height, channel.width, channel.cols, {values.data(), values.data() + values.size()}});
  }
}

py::array ids_array(const std::vector<std::int16_t>& indices, const ClassTable& classes, std::int32_t height,
                    std::int32_t width) {
  std::vector<std::int32_t> ids(indices.size());
  std::transform(indices.begin(), indices.end(), ids.begin(),
                 [&](std::int16_t index) { return index == kVoid ? -1 : classes.valid(index).id; });
  return array_of(std::move(ids), {height, width});
}

std::vector<std::int16_t> indices_of(const py::object& ids, const ClassTable& classes, std::int32_t height,
                                     std::int32_t width, const std::string& place) {
  const py::array given = py::array::ensure(ids);
  // Of 64 unsigned bits the largest would become -1, which is no label.
  if (given && given.dtype().kind() == 'u' && given.itemsize() == 8)
    return indices_in(shaped<std::uint64_t>(ids, {height, width}, place), classes, width, place);
  PyErr_Clear();
  return indices_in(shaped<std::int64_t>(ids, {height, width}, place), classes, width, place);
}

}  // namespace semfield::python
