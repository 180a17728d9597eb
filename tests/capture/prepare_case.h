// A folder with photographs and with programs that stand for COLMAP and ffmpeg.
#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "tests/capture/model_files.h"
#include "tests/program.h"

namespace semfield::testing_capture {

using namespace testing_room;
using namespace testing_program;
namespace fs = std::filesystem;

// Hands out models/ATTEMPT, counts its calls in `calls`, and does what files beside it say: fail_STEP, hang_STEP.
inline constexpr const char* kColmap = R"sh(#!/bin/sh
here=$(dirname "$0")
step=$1
echo "$*" >> "$here/calls"
if [ -e "$here/fail_$step" ]; then echo "before"; echo "E: the $step has no memory" >&2; exit 3; fi
if [ -e "$here/hang_$step" ]; then : > "$here/hangs"; exec sleep 100; fi
while [ $# -gt 0 ]; do
  case "$1" in
    --output_path) out=$2;;
    --input_path) in=$2;;
    --database_path) : > "$2";;
  esac
  shift
done
case "$step" in
  feature_extractor) echo "Processed file [6/6]";;
  mapper)
    n=$(grep -c '^mapper' "$here/calls")
    if [ -d "$here/models/$n" ]; then cp -r "$here/models/$n/." "$out"
    else echo "ERROR: failed to create sparse model"; exit 1; fi;;
  point_filtering) if [ -d "$here/filtered" ]; then in="$here/filtered"; fi; cp -r "$in/." "$out";;
  bundle_adjuster|image_deleter|image_registrator) cp -r "$in/." "$out";;
esac
)sh";
// The steps that follow a model.
inline const std::string kSettled =
    "point_filtering point_filtering bundle_adjuster point_filtering point_filtering bundle_adjuster point_filtering "
    "point_filtering bundle_adjuster point_filtering ";

// Eight seconds of film: small pictures of noise that changes, then the frames that are asked for. Of a panorama, one
// picture as each of its views.
inline constexpr const char* kFfmpeg = R"sh(#!/bin/sh
here=$(dirname "$0")
echo "ffmpeg $*" >> "$here/calls"
if [ -e "$here/fail_ffmpeg" ]; then echo "moov atom not found" >&2; exit 1; fi
for last; do
  case "$last" in */views/*_[0-9][0-9][0-9].jpg) cp "$here/frames/view.png" "$last";; esac
done
case "$last" in
  */views/*) ;;
  *.grey) cp "$here/film.grey" "$last";;
  *) i=0
     for image in "$here"/frames/*; do
       i=$((i+1))
       cp "$image" "$(dirname "$last")/00000$i.jpg"
     done;;
esac
)sh";
inline constexpr const char* kFfprobe = R"sh(#!/bin/sh
echo '{"streams": [{"codec_type": "video"}], "format": {"duration": "8.0"}}'
)sh";

class Prepare : public testing::Test {
 protected:
  void SetUp() override {
    home_ = fresh_folder("home");
    for (const char* folder : {"bin", "photographs"}) fs::create_directories(home_ + "/" + folder);
    tool("colmap", kColmap);
    for (int i = 0; i < 6; ++i) image(home_ + "/photographs/" + std::to_string(i) + ".png", i);
  }
  static void image(const std::string& path, int i) {
    write_png_rgb(path, 40, 30, render_room(room_camera(), room_pose(i)).rgb);
  }
  void tool(const std::string& name, const std::string& text) const {
    const std::string file = home_ + "/bin/" + name;
    plain_write(file, text);
    fs::permissions(file, fs::perms::owner_all);
  }
  std::string path_setting() const { return "PATH=" + home_ + "/bin:/usr/bin:/bin"; }
  Result prepare(const std::string& words = "photographs --out scene") const {
    return semfield_run("prepare " + words, home_, "PATH=" + shell_word(home_ + "/bin") + ":/usr/bin:/bin ");
  }
  void model(int attempt, int number, const std::vector<int>& images, double error_px = 0.5) const {
    write_room_model(home_ + "/bin/models/" + std::to_string(attempt) + "/" + std::to_string(number), images, error_px);
  }
  // First words of the calls so far, without the database.
  std::string steps() const {
    std::string out;
    const std::string calls = read_text_file(home_ + "/bin/calls");
    std::string_view rest = calls;
    for (std::string_view line; next_line(rest, line);) out += std::string(words_of(line)[0]) + " ";
    return out;
  }
  std::string home_;
};

}  // namespace semfield::testing_capture
