"""What a page owes to those who do not use a mouse, or do not see well; asked of a page in a browser."""

from typing import Any


def nameless(page: Any) -> list[str]:
    """Controls and pictures that a screen reader could not name."""
    return page.evaluate("""() => {
        const named = (each) => each.ariaLabel || each.labels?.length || each.getAttribute('aria-labelledby')
            || (each.matches('button, select') && each.textContent.trim())
            || (each.matches('img') && each.hasAttribute('alt'));
        return [...document.querySelectorAll('button, input, select, canvas, img, dialog, progress')]
            .filter((each) => !named(each)).map((each) => each.outerHTML.slice(0, 200)); }""")


def poor_contrast(page: Any) -> list[list[str]]:
    """Text that stands out from its background by less than 4.5 to 1, with the ratio: WCAG 2.2, 1.4.3.

    The background is the nearest one that is not clear.
    """
    return page.evaluate("""() => {
        const pen = document.createElement('canvas').getContext('2d', { willReadFrequently: true });
        const rgb = (color) => { pen.clearRect(0, 0, 1, 1); pen.fillStyle = color; pen.fillRect(0, 0, 1, 1);
            return [...pen.getImageData(0, 0, 1, 1).data]; };
        const light = (color) => { const [r, g, b] = color.map((c) => c / 255)
            .map((c) => (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4));
            return 0.2126 * r + 0.7152 * g + 0.0722 * b; };
        const behind = (each) => { for (let e = each; e; e = e.parentElement) {
            const color = rgb(getComputedStyle(e).backgroundColor); if (color[3] > 250) return color; }
            return rgb('white'); };
        const found = [];
        for (const each of document.querySelectorAll('body *')) {
            const text = [...each.childNodes].some((n) => n.nodeType === 3 && n.textContent.trim());
            if (!text || each.closest('script, style, option, dialog, svg, :disabled, [hidden], .unseen')) continue;
            const a = light(rgb(getComputedStyle(each).color)), b = light(behind(each));
            const ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
            if (ratio < 4.5) found.push([each.textContent.trim().slice(0, 30), ratio.toFixed(2)]);
        }
        return found; }""")


def tab_stops(page: Any, most: int = 400) -> list[tuple[str, bool]]:
    """Where the Tab key leads, in its order from the top of the page to its end, and whether the focus is seen there.

    Named by id, name or label. It is seen by an outline of its own or, where the control itself is clear, of its label.
    """
    page.evaluate("document.activeElement.blur(); getSelection().removeAllRanges(); scrollTo(0, 0)")
    stops: list[tuple[str, bool]] = []
    for _ in range(most):
        page.keyboard.press("Tab")
        name, seen, first = page.evaluate("""() => {
            const each = document.activeElement, outlined = (e) => {
                const { outlineStyle, outlineWidth } = getComputedStyle(e);
                return outlineStyle !== 'none' && parseFloat(outlineWidth) >= 2;
            };
            const seen = outlined(each) || (each.nextElementSibling !== null && outlined(each.nextElementSibling));
            const again = each === document.body || each.dataset.passed === 'yes';
            if (each !== document.body) each.dataset.passed = 'yes';
            return [each.id || each.name || each.ariaLabel || each.textContent.trim().slice(0, 40), seen, again]; }""")
        if first:  # the end of the page, or its beginning again
            return stops
        stops.append((name, seen))
    raise AssertionError(f"the Tab key still finds something new after {most} stops")
