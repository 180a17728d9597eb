#include "app/scene/posed_scene.h"

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <nlohmann/json.hpp>

#include "eval/image_output.h"
#include "formats/image_io.h"
#include "loading/frame_files.h"
#include "scene/classes/class_table.h"
#include "system/files.h"

namespace semfield::app {

namespace fs = std::filesystem;
using Json = nlohmann::ordered_json;

namespace {

constexpr const char* kLensModels[] = {"OPENCV", "OPENCV_FISHEYE", "EQUIRECTANGULAR"};

Json lens_json(const Camera& c) {
  Json out{{"camera_model", kLensModels[static_cast<std::size_t>(c.lens)]},
           {"w", c.width_px},
           {"h", c.height_px},
           {"fl_x", c.fx},
           {"fl_y", c.fy},
           {"cx", c.cx},
           {"cy", c.cy}};
  for (const auto& [key, value] :
       {std::pair{"k1", c.k1}, {"k2", c.k2}, {"k3", c.k3}, {"k4", c.k4}, {"p1", c.p1}, {"p2", c.p2}})
    if (value != 0) out[key] = value;
  return out;
}

// OpenGL axes, as this format has them; `turned` false: as they are.
Json matrix_json(const Pose& pose, bool turned) {
  Json out = Json::array();
  for (int r = 0; r < 3; ++r) {
    const auto& row = pose.r[static_cast<std::size_t>(r)];
    const double sign = turned ? -1 : 1;
    out.push_back({row[0], sign * row[1], sign * row[2], pose.t[r]});
  }
  out.push_back({0, 0, 0, 1});
  return out;
}

// A power of ten of the unit with which the farthest depth fits 16 bits.
double step_for(double farthest) {
  return farthest > 0 ? std::pow(10.0, std::ceil(std::log10(farthest / kMostDepthSteps))) : 1e-3;
}

}  // namespace

void write_fixed_scene(const PosedScene& scene, const FixedCameras& cameras, const std::string& folder,
                       const CaptureProgress& progress) {
  const SceneInfo& info = scene.info;
  const ClassTable classes = info.classes.empty() ? info.classes : with_void(info.classes);
  const fs::path out(folder);
  Json index = lens_json(cameras.cameras.front());
  // The file names one depth camera. Where lenses differ, depth is drawn into the colour images here.
  const std::vector<Camera>& of_depth = cameras.depth_cameras;
  const bool one_depth_camera =
      std::all_of(of_depth.begin(), of_depth.end(), [&](const Camera& c) { return c == of_depth.front(); });
  Json frames = Json::array(), train = Json::array(), test = Json::array();
  for (std::size_t i = 0; i < info.frames.size(); ++i) {
    const FrameInfo& frame = info.frames[i];
    progress({"writing", "frames"}, static_cast<double>(i), static_cast<double>(info.frames.size()));
    FrameBuffer pixels;
    scene.read(static_cast<int>(i), pixels);
    const MapSize size{pixels.width_px, pixels.height_px};
    const auto path = [&](const char* kind, const std::string& end) {
      const std::string name = std::string(kind) + "/" + frame.name + end;
      create_folders((out / name).parent_path().string());
      return name;
    };
    Json one;
    const std::string end = fs::path(frame.source).extension().string();
    if (is_photograph_file(frame) && frame.orientation == 1) {
      one["file_path"] = path("images", end);
      write_file_atomic((out / one["file_path"].get<std::string>()).string(),
                        read_text_file(frame.source, std::size_t{1} << 32));
    } else {
      one["file_path"] = path("images", ".png");
      write_png_rgb((out / one["file_path"].get<std::string>()).string(), size.width_px, size.height_px, pixels.rgb);
    }
    (frame.split == Split::test ? test : train).push_back(one["file_path"]);
    if (frame.split == Split::unused) train.erase(train.size() - 1);
    if (frame.has_depth) {
      if (cameras.depth_apart && !one_depth_camera)
        pixels.depth_m = drawn_depth({pixels.width_px, pixels.height_px, 1, std::move(pixels.depth_m)},
                                     {of_depth[i], cameras.depth_from_color}, cameras.cameras[i]);
      double farthest = 0;
      for (const float d : pixels.depth_m) farthest = std::max(farthest, std::isfinite(d) ? static_cast<double>(d) : 0);
      const double step = step_for(farthest);
      one["depth_path"] = path("depth", ".png");
      one["depth_unit_m"] = step;
      write_depth((out / one["depth_path"].get<std::string>()).string(), size, pixels.depth_m, step);
    }
    if (frame.has_labels) {
      one["label_path"] = path("label", ".png");
      write_label_ids((out / one["label_path"].get<std::string>()).string(), size, pixels.label, classes);
    }
    if (frame.has_instances) {
      one["instance_path"] = path("instance", ".png");
      std::vector<std::uint16_t> ids;
      for (const std::int32_t id : pixels.instance) {
        if (id < 0 || id > 65535)
          throw Error(ErrorKind::data, "capture.instance.range",
                      "frame " + frame.name + ": instance " + std::to_string(id) + " does not fit 16 bits");
        ids.push_back(static_cast<std::uint16_t>(id));
      }
      write_png_gray16((out / one["instance_path"].get<std::string>()).string(), size.width_px, size.height_px, ids);
    }
    if (!pixels.used.empty()) {
      one["mask_path"] = path("mask", ".png");
      std::vector<std::uint8_t> used;
      for (const std::uint8_t u : pixels.used) used.push_back(u != 0 ? 255 : 0);
      write_png_gray8((out / one["mask_path"].get<std::string>()).string(), size.width_px, size.height_px, used);
    }
    one["transform_matrix"] = matrix_json(cameras.poses[i], true);
    const Json lens = lens_json(cameras.cameras[i]);
    for (const auto& [key, value] : lens.items())
      if (!index.contains(key) || index[key] != value) one[key] = value;
    for (const char* key : {"k1", "k2", "k3", "k4", "p1", "p2"})
      if (index.contains(key) && !lens.contains(key)) one[key] = 0;
    frames.push_back(std::move(one));
  }
  if (cameras.depth_apart && one_depth_camera) {
    index["depth_camera"] = lens_json(of_depth.front());
    index["depth_camera"]["depth_from_color"] = matrix_json(cameras.depth_from_color, false);
  }
  if (!classes.empty()) {
    write_file_atomic((out / "classes.yaml").string(), classes.to_yaml());
    index["classes"] = "classes.yaml";
  }
  if (!test.empty()) {
    index["train_filenames"] = std::move(train);
    index["test_filenames"] = std::move(test);
  }
  index["prepared_from"] = info.name;
  index["camera_changes"] = cameras.changes;
  index["frames"] = std::move(frames);
  write_file_atomic((out / "transforms.json").string(),
                    index.dump(1, ' ', false, Json::error_handler_t::replace) + "\n");
}

}  // namespace semfield::app
