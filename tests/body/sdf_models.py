"""Parts of SDFormat files, as texts."""

SHAPE = "<box><size>0.1 0.2 0.3</size></box>"
LIMITS = "<limit><lower>-1</lower><upper>1</upper></limit>"


def link(name, shape=SHAPE, more=""):
    visual = f'<visual name="v"><geometry>{shape}</geometry></visual>' if shape else ""
    return f'<link name="{name}">{visual}{more}</link>'


def joint(name, parent, child, more=LIMITS, kind="revolute"):
    return (
        f'<joint name="{name}" type="{kind}"><parent>{parent}</parent><child>{child}</child>'
        f"<axis><xyz>0 0 1</xyz>{more}</axis></joint>"
    )


def sdf(*parts, name="m"):
    return f'<sdf version="1.9"><model name="{name}">{"".join(parts)}</model></sdf>'


def collision(mesh):
    shape = f"<geometry><mesh><uri>{mesh}</uri></mesh></geometry>"
    return f'<collision name="c">{shape}</collision>'
