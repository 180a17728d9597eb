// The saves that faults are thrown into, and what a fresh process finds after one.
#pragma once

#include <algorithm>

#include "core/checksum.h"
#include "core/files.h"
#include "labels/clicks.h"
#include "scene/loading/packed_scene.h"
#include "tests/scene/tiny_scene.h"
#include "train/run_folder.h"

namespace semfield::testing_crash {

/// `checkpoint`: step 300 over 100 and 200, with `latest`, the deletion of 100 and a later, damaged step 400 that steps
/// aside. `clicks`: an event appended to a log, which is no file that replaces another. `first`: a
/// first checkpoint, in a folder that does not exist yet. `scene`: a packed scene over another.
/// `text`: a run folder's run.yaml over another.
enum class Save { checkpoint, first, scene, text, clicks };
/// Those that replace a file.
inline constexpr Save kSaves[] = {Save::checkpoint, Save::first, Save::scene, Save::text};
inline const char* name_of(Save what) {
  return what == Save::clicks       ? "clicks"
         : what == Save::checkpoint ? "checkpoint"
         : what == Save::first      ? "first"
         : what == Save::scene      ? "scene"
                                    : "text";
}

struct Look {
  std::uint32_t crc = 0;  ///< of the newest file that verifies, byte for byte; 0: there is none
  int temporaries = 0;    ///< files named *.tmp below the folder, after what a next start does
  std::string bad;        ///< anything that is not as promised; empty: all is well
};

inline std::string checkpoints(const std::string& folder) { return folder + "/checkpoints"; }

inline void save_step(CheckpointStore& store, int step) {
  std::vector<float> values(700);
  for (std::size_t i = 0; i < values.size(); ++i) values[i] = static_cast<float>(step) + 0.25F * static_cast<float>(i);
  store.save(step, {tensor_ref("main/field/hidden_0/weight", {700}, values)}, {{"step", std::to_string(step)}});
}

inline void write_scene(const std::string& folder, int version) {
  SceneInfo info{.name = "room " + std::to_string(version),
                 .classes = table_of_names({"void", "west", "east", "up", "down", "south", "north"})};
  for (int i = 0; i < 2; ++i) {
    FrameInfo frame{.name = "frame_" + std::to_string(i),
                    .camera = testing_room::room_camera(8, 6),
                    .world_from_camera = testing_room::room_pose(i + version)};
    info.frames.push_back(frame);
  }
  write_packed_scene(folder + "/room.sfpack", info, [&](int i, FrameBuffer& out) {
    const FrameInfo& frame = info.frames[i];
    out = testing_room::render_room(frame.camera, frame.world_from_camera);
  });
}

/// The log of the save `clicks`, and its events: "click-0", ...
inline std::string click_log_path(const std::string& folder) { return folder + "/clicks.jsonl"; }

inline LabelEvent click_event(int number) {
  return LabelEvent{.id = "click-" + std::to_string(number),
                    .frame = "rgb_12",
                    .width_px = 320,
                    .height_px = 240,
                    .points = {{0.5 + number % 320, 33}, {12.25, 0.1 * (number % 2000)}},
                    .radius_px = 4,
                    .class_name = "chair"};
}

inline std::string text_of(int version) {
  return "name: version_" + std::to_string(version) + "\n" + std::string(9000, static_cast<char>('a' + version)) + "\n";
}

inline int count_temporaries(const std::string& folder) {
  int count = 0;
  std::error_code error;
  for (fs::recursive_directory_iterator entry(folder, error), end; !error && entry != end; entry.increment(error))
    count += entry->path().extension() == ".tmp" ? 1 : 0;
  return count;
}

inline std::uint32_t crc_of(const std::string& path) {
  const std::string bytes = read_text_file(path);
  return crc32c(std::as_bytes(std::span(bytes)));
}

inline void look_at_checkpoints(const std::string& folder, Look& out) {
  const CheckpointStore store(checkpoints(folder));
  Diagnostics diagnostics;
  const auto found = store.find_latest(diagnostics);
  for (const Diagnostic& finding : diagnostics.all()) {
    if (finding.where.find("step_00000400") == std::string::npos) out.bad += finding.text() + "\n";
  }
  if (!found) return;
  out.crc = crc_of(found->path);
  // `latest` is for people and other programs: what it names must be there and whole.
  const std::string latest = checkpoints(folder) + "/latest";
  if (!fs::exists(latest)) return;
  std::string name = read_text_file(latest);
  name.erase(std::remove(name.begin(), name.end(), '\n'), name.end());
  (void)TensorFile::read(checkpoints(folder) + "/" + name);
}

inline void append_clicks(const std::string& folder, int first, int count) {
  Diagnostics none;
  ClickLog log = ClickLog::open(click_log_path(folder), none);
  for (int i = first; i < first + count; ++i) log.append(click_event(i));
}

inline void look_at_scene(const std::string& folder, Look& out) {
  const PackedScene scene(folder + "/room.sfpack");
  FrameBuffer buffer;
  for (std::size_t i = 0; i < scene.info().frames.size(); ++i) scene.read(static_cast<int>(i), buffer);
  out.crc = crc_of(folder + "/room.sfpack");
  // Nobody starts up in a folder of scenes: what is left goes when the same file is packed again.
  remove_stale_temporaries(folder);
}

inline Save save_of(const std::string& name) {
  if (name == name_of(Save::clicks)) return Save::clicks;
  return *std::find_if(std::begin(kSaves), std::end(kSaves), [&](Save what) { return name == name_of(what); });
}

/// The state before, in an empty folder.
inline void prepare(Save what, const std::string& folder) {
  if (what == Save::clicks) append_clicks(folder, 0, 2);
  if (what == Save::scene) write_scene(folder, 0);
  if (what == Save::text) write_file_atomic(folder + "/run.yaml", text_of(0));
  if (what != Save::checkpoint) return;
  CheckpointStore store(checkpoints(folder));
  save_step(store, 100);
  save_step(store, 200);
  testing_room::plain_write(checkpoints(folder) + "/" + CheckpointStore::file_name(400), "damaged");
}

/// The save itself. Throws Error.
inline void perform(Save what, const std::string& folder) {
  if (what == Save::clicks) return append_clicks(folder, 2, 1);
  if (what == Save::scene) write_scene(folder, 1);
  if (what == Save::text) write_file_atomic(folder + "/run.yaml", text_of(1));
  if (what == Save::scene || what == Save::text) return;
  CheckpointStore store(checkpoints(folder));
  save_step(store, 300);
}

/// As the next process does: cleans up, finds the newest that verifies, reads all of it.
inline Look look(Save what, const std::string& folder) {
  Look out;
  try {
    if (what == Save::scene) {
      look_at_scene(folder, out);
    } else if (what == Save::clicks) {
      Diagnostics torn;
      (void)ClickLog::open(click_log_path(folder), torn);
      out.crc = crc_of(click_log_path(folder));
    } else if (what == Save::text) {
      const RunFolder run = RunFolder::resume(folder);
      out.crc = crc_of(run.config_path());
    } else {
      look_at_checkpoints(folder, out);
    }
  } catch (const std::exception& error) {
    out.bad += error.what();
  }
  out.temporaries = count_temporaries(folder);
  return out;
}

}  // namespace semfield::testing_crash
