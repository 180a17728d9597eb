// The library behind image_formats(): the only user of OpenImageIO.
#include <OpenImageIO/imageio.h>

#include <memory>

#include "core/error.h"
#include "formats/image_io.h"

namespace semfield {

namespace {

std::unique_ptr<OIIO::ImageInput> open_input(const std::string& path) {
  // Alpha stays apart from colour; the background is our caller's choice.
  OIIO::ImageSpec config;
  config["oiio:UnassociatedAlpha"] = 1;
  auto input = OIIO::ImageInput::open(path, &config);
  if (!input) {
    throw Error(ErrorKind::data, "files.image.unreadable", "not readable as an image: " + OIIO::geterror(),
                "export it as PNG or JPEG");
  }
  const OIIO::ImageSpec& spec = input->spec();
  check_image_limits(spec.width, spec.height, spec.nchannels, static_cast<std::int64_t>(spec.format.basesize()));
  // Both hold more values than width x height x channels, and would be decoded over the end of our array.
  if (spec.depth > 1 || spec.deep)
    throw Error(ErrorKind::data, "files.image.kind", "is a volume or a deep image, not a picture",
                "export it as PNG or JPEG");
  return input;
}

ImageSize size(const std::string& path) {
  const auto input = open_input(path);
  const OIIO::ImageSpec& spec = input->spec();
  const int orientation = spec.get_int_attribute("Orientation", 1);
  return {spec.width, spec.height, spec.nchannels, static_cast<int>(spec.format.basesize() * 8),
          orientation >= 1 && orientation <= 8 ? orientation : 1};
}

CameraTag camera(const std::string& path) {
  const auto input = open_input(path);
  const OIIO::ImageSpec& spec = input->spec();
  const std::string make(spec.get_string_attribute("Make")), model(spec.get_string_attribute("Model"));
  return {make.empty() || model.empty() ? make + model : make + " " + model,
          static_cast<double>(spec.get_float_attribute("Exif:FocalLength"))};
}

template <class T>
Image<T> read(const std::string& path, OIIO::TypeDesc type) {
  auto input = open_input(path);
  const OIIO::ImageSpec spec = input->spec();
  if (spec.nchannels < 1)
    throw Error(ErrorKind::data, "files.image.unreadable", "image has no channels", "export it as PNG or JPEG");
  check_image_limits(spec.width, spec.height, spec.nchannels, sizeof(T));
  Image<T> out{spec.width, spec.height, spec.nchannels, {}};
  out.pixels.resize(static_cast<std::size_t>(spec.width) * static_cast<std::size_t>(spec.height) *
                    static_cast<std::size_t>(spec.nchannels));
  if (!input->read_image(0, 0, 0, spec.nchannels, type, out.pixels.data())) {
    throw Error(ErrorKind::data, "files.image.damaged", "cannot be decoded: " + input->geterror(),
                "copy or export the file again");
  }
  return out;
}

constexpr ImageFormats kFormats{
    size, camera, [](const std::string& path) { return read<std::uint8_t>(path, OIIO::TypeDesc::UINT8); },
    [](const std::string& path) { return read<std::uint16_t>(path, OIIO::TypeDesc::UINT16); },
    [](const std::string& path) { return read<float>(path, OIIO::TypeDesc::FLOAT); }};

}  // namespace

}  // namespace semfield

extern "C" __attribute__((visibility("default"))) const semfield::ImageFormats* semfield_image_formats();
extern "C" const semfield::ImageFormats* semfield_image_formats() { return &semfield::kFormats; }
