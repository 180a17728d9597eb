#include "app/serve/jpeg.h"

#include <turbojpeg.h>

#include <memory>
#include <string>

#include "core/check.h"
#include "core/error.h"

namespace semfield::app {

std::vector<std::uint8_t> encode_jpeg(std::int32_t width_px, std::int32_t height_px, std::span<const std::uint8_t> rgb,
                                      int quality) {
  SEMFIELD_CHECK(
      width_px > 0 && height_px > 0 &&
          rgb.size() == std::size_t{3} * static_cast<std::size_t>(width_px) * static_cast<std::size_t>(height_px),
      "a picture's colours do not match its size");
  const std::unique_ptr<void, int (*)(tjhandle)> encoder(tjInitCompress(), tjDestroy);
  if (!encoder)
    throw Error(ErrorKind::internal, "internal.jpeg.failed",
                std::string("TurboJPEG cannot start: ") + tjGetErrorStr2(nullptr));
  std::vector<std::uint8_t> out(tjBufSize(width_px, height_px, TJSAMP_420));
  unsigned char* at = out.data();
  unsigned long bytes = out.size();
  // The buffer is large enough for any picture, so it is never replaced by another.
  if (tjCompress2(encoder.get(), rgb.data(), width_px, 0, height_px, TJPF_RGB, &at, &bytes, TJSAMP_420, quality,
                  TJFLAG_NOREALLOC) != 0)
    throw Error(ErrorKind::internal, "internal.jpeg.failed",
                std::string("TurboJPEG: ") + tjGetErrorStr2(encoder.get()));
  out.resize(bytes);
  return out;
}

}  // namespace semfield::app
